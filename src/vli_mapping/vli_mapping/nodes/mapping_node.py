"""Windows, laser points and long images in; the map, and constraints on the window, out."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

from sensor_msgs.msg import Image as ImageMessage

from vli_common.calibration import Calibration
from vli_common.camera import CameraModel
from vli_common.config import parameter
from vli_common.errors import OutputError, VliError
from vli_common.messages import (
    Session,
    cloud_to_message,
    constraints_to_message,
    image_from_message,
    relocalisation_to_message,
    scan_from_message,
    window_from_message,
)
from vli_common.node import VliNode, run_node
from vli_common.status import Health
from vli_common.topics import CLOUD, IMAGE_LONG, LASER_POINTS, MAP, MAP_CONSTRAINTS, MAP_UPDATE, RELOCALISATION, WINDOW
from vli_common.types import Counters, Image, LaserScan, PointCloud, WindowPoses
from vli_mapping.albedo import finished_cloud
from vli_mapping.config import AS_SEEN, MappingConfig
from vli_mapping.export import write_cloud
from vli_mapping.light import Light
from vli_mapping.map_file import SUFFIX, load_map, map_origin, save_map, session_of, session_origin
from vli_mapping.mapper import Mapper
from vli_mapping.mesh import make_mesh, write_mesh
from vli_mapping.photographs import Photograph, develop
from vli_mapping.point_map import PointMap, Stripe
from vli_mapping.snapshot import Snapshot, restore, take, view
from vli_mapping.warm_up import warm_up

_MAP_PERIOD_S = 2.0
_AUTOSAVE_CHECK_S = 0.2
_LAST_SAVE_S = 5.0
"""An automatic save that is under way when the node is stopped gets this long, before the last one."""
_BACK_END = WINDOW.sources[0]
_WAITING_IMAGES = 300
"""Ten seconds of long images, as many as the mapper keeps: a scan whose images were dropped would stay grey. 280 MB at VGA."""


@dataclass(frozen=True)
class StoreConfig:
    """Where the map is saved, relative to the directory the node runs in."""

    save_path: str = parameter(
        "map.ply", doc="file that ~/save writes: .vli has all of the map, .ply .pcd .las .laz .e57 its points"
    )
    load_path: str = parameter("map.vli", doc="file that ~/load reads: what was saved as .vli")
    export_path: str = parameter("mesh.ply", doc="mesh that ~/export writes: .ply .stl .obj .glb")
    autosave_s: float = parameter(
        0.0, unit="s", minimum=0.0, maximum=86400.0, doc="save the map to autosave_path this often; 0: never"
    )
    autosave_path: str = parameter(
        "autosave.vli", doc="file of the automatic saves: all of the map; those of sessions that have ended get their number"
    )
    reload_autosave: bool = parameter(
        True, doc="go on with the map in autosave_path where this node was started anew in the session that it is of"
    )


class MappingNode(VliNode):
    """Coloured map, and window-to-map correspondences, eq. (4)."""

    def __init__(self) -> None:
        super().__init__("mapping_node", {MappingConfig: "", StoreConfig: ""})
        self._mapper: Mapper | None = None
        self._published_points = -1
        for topic in (CLOUD, MAP, MAP_UPDATE, MAP_CONSTRAINTS, RELOCALISATION):
            self.advertise(topic)
        self.receive(IMAGE_LONG, self._read_image, self._on_image, limit=_WAITING_IMAGES)
        self.receive(LASER_POINTS, scan_from_message, self._on_scan)
        self.receive(WINDOW, window_from_message, self._on_window)
        self.serve("save", self._save, aside=True)
        self.serve("load", self._load, aside=True)
        self.serve("export", self._export, aside=True)
        self.serve("clear", self._clear, aside=True)
        self._is_resumed = False
        self._saving, self._lighting = threading.Lock(), threading.Lock()
        self.every(_AUTOSAVE_CHECK_S, self._look_after_autosave)
        self._autosaved_s = time.monotonic()
        self._initial = self._saved = (0, 0, 0)
        self.every(_MAP_PERIOD_S, self._look_after_map)

    def create_stage(self, calibration: Calibration | None) -> None:
        """Make the mapper."""
        if calibration is not None:
            warm_up()
            self._keep_map()
            self._mapper = Mapper(calibration, self.parameters.config(MappingConfig), self.mode)

    def drop_stage(self) -> None:
        """Let go of the mapper and its map."""
        self._mapper = None

    def on_session(self, session: Session) -> None:
        """Begin a map; where maps are saved automatically, the one so far is kept."""
        self._keep_map()
        self.mapper.reset(session.number)
        self._initial = self._version

    def on_restart(self, node: str) -> None:
        """Begin a session where the back end begins a frame of its own: its poses do not belong to the map so far."""
        if node == _BACK_END and self._mapper is not None and (len(self._mapper.map) or self.received(WINDOW)):
            self.raise_session(f"{node} was started anew")

    def on_finish(self) -> None:
        """Publish the map as it is in the end."""
        if self._mapper is not None:
            self._mapper.light()
        self._publish_map()

    def stage_counters(self) -> Counters:
        """Return the counters of the mapper."""
        return self._mapper.counters if self._mapper else Counters()

    def stage_status(self) -> tuple[Health, str, dict[str, str]]:
        """Return the size of the map, whether the scanner knows its place in it, and whether the scene is still as mapped."""
        if self._mapper is None:
            return Health.OK, "", {"points": "0"}
        hint = self._mapper.hint
        return Health.WARN if hint else Health.OK, hint, {"points": str(len(self._mapper.map))}

    @property
    def mapper(self) -> Mapper:
        """The mapper, which is there once the node is ready."""
        return self.existing(self._mapper)

    def _read_image(self, message: ImageMessage) -> Image:
        return image_from_message(message, self.session, self.existing(self.calibration).camera)

    def _on_image(self, image: Image) -> None:
        self.mapper.add_image(image)

    def _on_scan(self, scan: LaserScan) -> None:
        self.mapper.add_scan(scan)

    def _on_window(self, window: WindowPoses) -> None:
        output = self.mapper.add_window(window)
        if output.relocalisation is not None:
            self.send(RELOCALISATION, relocalisation_to_message(output.relocalisation))
        if output.constraints is not None:
            self.send(MAP_CONSTRAINTS, constraints_to_message(output.constraints))
        if output.cloud is not None and self.has_listener(CLOUD):
            self.send(CLOUD, cloud_to_message(output.cloud))
        if output.update is not None and self.has_listener(MAP_UPDATE):
            self.send(MAP_UPDATE, cloud_to_message(output.update))

    def _look_after_map(self) -> None:
        """Find the light anew where someone looks, then publish the map; in a thread of its own, and never two at a time."""
        is_watched = self.has_listener(MAP) or self.has_listener(MAP_UPDATE)
        if self._mapper is not None and is_watched and self._lighting.acquire(blocking=False):
            threading.Thread(target=self._publish_in_light, daemon=True).start()

    def _publish_in_light(self) -> None:
        # A node that is busy, or cleaned up meanwhile, is asked again.
        try:
            with suppress(VliError):
                self.call(self.mapper.light_fit)()
                self.enqueue(self._publish_map)
        finally:
            self._lighting.release()

    def _publish_map(self) -> None:
        """Publish the whole map where someone listens and it has changed."""
        if self._mapper is None or not self.has_listener(MAP) or len(self._mapper.map) == self._published_points:
            return
        self._published_points = len(self._mapper.map)
        limit = self.parameters.config(MappingConfig).max_published_points
        stamp_ns = self.get_clock().now().nanoseconds
        self.send(MAP, cloud_to_message(self._mapper.cloud(limit, stamp_ns, self.session)))

    def _save(self) -> str:
        """Copy the map step by step in the worker, where nothing changes it meanwhile, and write it here."""
        path = self._path("save_path")
        if path.suffix == SUFFIX:
            count = self._save_all(path)
        else:
            count = len(cloud := self._cloud(path))
            write_cloud(path, cloud)
        return f"{count} points in '{path}'"

    def _load(self) -> str:
        """Read a saved map; the one in memory stays where that fails."""
        path = self._path("load_path")
        snapshot = load_map(path)
        self.call(lambda: self.mapper.adopt(snapshot))
        return f"{len(snapshot)} points from '{path}'; scans enter once the scanner has found its place in it"

    def _export(self) -> str:
        path = self._path("export_path")
        mesh = make_mesh(self._cloud(path))
        write_mesh(path, mesh)
        return f"{len(mesh.faces)} triangles in '{path}'"

    def close(self) -> bool:
        """Save a last time where the map is saved automatically, then stop."""
        is_asked = self._is_resumed and self.parameters.config(StoreConfig).autosave_s
        if is_asked and self._has_more and self._saving.acquire(timeout=_LAST_SAVE_S):
            self._autosave()
        return super().close()

    @property
    def _version(self) -> tuple[int, int, int]:
        """Changes with the map: session, scans that have entered, points."""
        return self.mapper.session, self.mapper.counters["scans_entered"], len(self.mapper.map)

    @property
    def _has_more(self) -> bool:
        """True where the map has what neither the session began with nor the last file of all of it has.

        Not after a failure: nobody knows whether the map is sound, and the last save is.
        """
        if self._mapper is None or self.failure is not None or not len(self._mapper.map):
            return False
        return self._version not in (self._initial, self._saved)

    @property
    def _origin(self) -> str:
        """Names the frame of the map: the session, of this back end; empty where the back end is not known, or elsewhere."""
        status = self.others.get(_BACK_END)
        if status is None or self._mapper is None or status.values.get("session") != str(self.session):
            return ""
        return session_origin(self.session, f"{_BACK_END} {status.values.get('started_ns', '')}")

    def _look_after_autosave(self) -> None:
        """Resume a predecessor's map once it is known which is the present frame; from then on save when it is time.

        In a thread of its own, and never two at a time.
        """
        config = self.parameters.config(StoreConfig)
        is_due = time.monotonic() > self._autosaved_s + config.autosave_s and self._has_more
        job = (self._autosave if is_due else None) if self._is_resumed else (self._resume_autosave if self._origin else None)
        if config.autosave_s and job and self._saving.acquire(blocking=False):
            threading.Thread(target=job, daemon=True).start()

    def _resume_autosave(self) -> None:
        """Go on with the map that was saved in this session; keep one of another aside, lest the next save replaces it."""
        path, origin = self._path("autosave_path"), self._origin
        try:
            saved = map_origin(path)
            if origin and saved == origin and self.parameters.config(StoreConfig).reload_autosave:
                snapshot = load_map(path)
                self.call(lambda: self.mapper.resume(snapshot))
                self.get_logger().info(f"goes on with {len(snapshot)} points from '{path}'")
            elif path.exists():
                kept = path.with_stem(f"{path.stem}_previous")
                path.replace(kept)
                self.get_logger().info(f"keeps the map of an earlier session as '{kept}'")
        except (VliError, OSError) as error:
            self.get_logger().error(f"map of an earlier session: {error}")
        finally:
            self._is_resumed = True
            self._saving.release()

    def _autosave(self) -> None:
        self._autosaved_s = time.monotonic()
        path = self._path("autosave_path")
        try:
            version, origin = self.call(self._settled_version), self._origin
            snapshot = self._snapshot(path)
            # A session that ends meanwhile has its map kept; it must not be saved as the next one's.
            if self._origin == origin and self.session == version[0]:
                save_map(path, replace(snapshot, origin=origin))
                self._saved = version
        except VliError as error:
            self.get_logger().error(f"automatic save: {error}", throttle_duration_sec=60.0)
        finally:
            self._saving.release()

    def _save_all(self, path: Path) -> int:
        """Write all of the map; return how many points it has."""
        version = self.call(self._settled_version)
        whole, light = self._finished(path)
        save_map(path, replace(view(whole, light), origin=self._origin))
        self._saved = version
        return len(whole)

    def _keep_map(self) -> None:
        """Write the map of the session that ends where automatic saves go, in a thread: nobody changes it any more."""
        mapper = self._mapper
        if mapper is None or not self.parameters.config(StoreConfig).autosave_s:
            return
        mapper.settle()
        waiting = mapper.waiting()
        if not waiting and (self._version == self._initial or not len(mapper.map)):
            return
        number, autosave = mapper.session, self._path("autosave_path")
        path = autosave.with_stem(f"{autosave.stem}_session-{number}")
        # The mapper goes on with a map in which there is nothing.
        whole = mapper.map if len(mapper.map) else PointMap(mapper.config.map)
        fit, photographs = mapper.light_fit(), mapper.photographs()

        def write() -> None:
            light = fit()
            _complete(whole, light, mapper.camera, waiting, photographs)
            try:
                save_map(path, view(whole, light))
                self.get_logger().info(f"keeps the map of the session that has ended as '{path}'")
                # Else it would pass for one of the session that begins.
                with self._saving:
                    if session_of(autosave) == number:
                        autosave.unlink()
            except (VliError, OSError) as error:
                self.get_logger().error(f"map of the session that has ended: {error}")

        self.do_aside(write)

    def _settled_version(self) -> tuple[int, int, int]:
        self.mapper.settle()
        return self._version

    def _finished(self, path: Path) -> tuple[PointMap, Light | None]:
        """Return a copy of the map as it were if the scan ended here, and the light on board.

        With the scans of the window as they are now; the map itself gets them when their poses are final.
        """
        light = self.call(self._settled_fit)()
        waiting, photographs = self.call(self.mapper.waiting), self.call(self.mapper.photographs)
        snapshot = take(self.mapper.map, light, self.call)
        whole = restore(snapshot, self.parameters.config(MappingConfig).map)
        _complete(whole, light, self.mapper.camera, waiting, photographs)
        if not len(whole):
            raise OutputError(f"the map is empty, '{path}' is not written")
        return whole, light

    def _snapshot(self, path: Path) -> Snapshot:
        light = self.call(self._settled_fit)()
        snapshot = take(self.mapper.map, light, self.call)
        if not len(snapshot):
            raise OutputError(f"the map is empty, '{path}' is not written")
        return snapshot

    def _settled_fit(self) -> Callable[[], Light | None]:
        self.mapper.settle()
        return self.mapper.light_fit()

    def _cloud(self, path: Path) -> PointCloud:
        as_seen = self.parameters.config(MappingConfig).colour == AS_SEEN
        return finished_cloud(*self._finished(path), as_seen)

    def _path(self, name: str) -> Path:
        return Path(getattr(self.parameters.config(StoreConfig), name)).absolute()

    def _clear(self) -> str:
        self.call(lambda: self.mapper.reset(self.session))
        return "the map is empty"


def _complete(
    whole: PointMap, light: Light | None, camera: CameraModel, waiting: Iterable[Stripe], photographs: Sequence[Photograph]
) -> None:
    """Give a map that nobody else changes what it would get if the scan ended here."""
    for stripe in waiting:
        whole.insert(stripe)
    develop(whole, light, camera, photographs)


def main() -> None:
    """Run the node."""
    run_node(MappingNode)


if __name__ == "__main__":
    main()
