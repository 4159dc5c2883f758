"""Windows, laser points and long images in; the map, and constraints on the window, out."""

from __future__ import annotations

import sys
import threading
import time
from dataclasses import dataclass
from pathlib import Path

from sensor_msgs.msg import Image as ImageMessage

from vli_common.calibration import Calibration
from vli_common.config import parameter
from vli_common.errors import OutputError, VliError
from vli_common.messages import (
    Session,
    cloud_to_message,
    constraints_to_message,
    image_from_message,
    scan_from_message,
    window_from_message,
)
from vli_common.node import VliNode, run_node
from vli_common.status import Health
from vli_common.topics import CLOUD, IMAGE_LONG, LASER_POINTS, MAP, MAP_CONSTRAINTS, MAP_UPDATE, WINDOW
from vli_common.types import Counters, Image, LaserScan, PointCloud, WindowPoses
from vli_mapping.config import AS_SEEN, MappingConfig
from vli_mapping.export import write_cloud
from vli_mapping.light import Light
from vli_mapping.map_file import SUFFIX, load_map, save_map
from vli_mapping.mapper import Mapper
from vli_mapping.mesh import make_mesh, write_mesh
from vli_mapping.snapshot import Snapshot, restore, take
from vli_mapping.warm_up import warm_up

_MAP_PERIOD_S = 2.0
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
    autosave_path: str = parameter("autosave.vli", doc="file of the automatic saves: all of the map")


class MappingNode(VliNode):
    """Coloured map, and window-to-map correspondences, eq. (4)."""

    def __init__(self) -> None:
        super().__init__("mapping_node", {MappingConfig: "", StoreConfig: ""})
        self._mapper: Mapper | None = None
        self._published_points = -1
        for topic in (CLOUD, MAP, MAP_UPDATE, MAP_CONSTRAINTS):
            self.advertise(topic)
        self.receive(IMAGE_LONG, self._read_image, self._on_image, limit=_WAITING_IMAGES)
        self.receive(LASER_POINTS, scan_from_message, self._on_scan)
        self.receive(WINDOW, window_from_message, self._on_window)
        self.serve("save", self._save)
        self.serve("load", self._load)
        self.serve("export", self._export)
        self.serve("clear", self._clear)
        self._autosave_started = threading.Lock()
        self.create_timer(1.0, self._autosave_when_due)
        self._autosaved_s = time.monotonic()
        self.create_timer(_MAP_PERIOD_S, lambda: self.enqueue(self._publish_map))

    def create_stage(self, calibration: Calibration | None) -> None:
        """Make the mapper."""
        if calibration is not None:
            warm_up()
            self._mapper = Mapper(calibration, self.parameters.config(MappingConfig), self.mode)

    def drop_stage(self) -> None:
        """Let go of the mapper and its map."""
        self._mapper = None

    def on_session(self, session: Session) -> None:
        """Begin a map."""
        self.mapper.reset(session.number)

    def on_finish(self) -> None:
        """Publish the map as it is in the end."""
        self._publish_map()

    def stage_counters(self) -> Counters:
        """Return the counters of the mapper."""
        return self._mapper.counters if self._mapper else Counters()

    def stage_status(self) -> tuple[Health, str, dict[str, str]]:
        """Return the size of the map."""
        return Health.OK, "", {"points": str(len(self._mapper.map) if self._mapper else 0)}

    @property
    def mapper(self) -> Mapper:
        """The mapper, which is there once the node is ready."""
        return self.existing(self._mapper)

    def _read_image(self, message: ImageMessage) -> Image:
        return image_from_message(message, self.session)

    def _on_image(self, image: Image) -> None:
        self.mapper.add_image(image)

    def _on_scan(self, scan: LaserScan) -> None:
        self.mapper.add_scan(scan)

    def _on_window(self, window: WindowPoses) -> None:
        output = self.mapper.add_window(window)
        if output.constraints is not None:
            self.send(MAP_CONSTRAINTS, constraints_to_message(output.constraints))
        if output.cloud is not None and self.has_listener(CLOUD):
            self.send(CLOUD, cloud_to_message(output.cloud))
        if output.update is not None and self.has_listener(MAP_UPDATE):
            self.send(MAP_UPDATE, cloud_to_message(output.update))

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
        return f"{len(snapshot)} points from '{path}'; scans enter again after ~/clear"

    def _export(self) -> str:
        path = self._path("export_path")
        mesh = make_mesh(self._cloud(path))
        write_mesh(path, mesh)
        return f"{len(mesh.faces)} triangles in '{path}'"

    def _autosave_when_due(self) -> None:
        """Save in a thread of its own when it is time and no save is under way."""
        period_s = self.parameters.config(StoreConfig).autosave_s
        if not period_s or self._mapper is None or time.monotonic() < self._autosaved_s + period_s:
            return
        if len(self._mapper.map) and self._autosave_started.acquire(blocking=False):
            self._autosaved_s = time.monotonic()
            threading.Thread(target=self._autosave, daemon=True).start()

    def _autosave(self) -> None:
        path = self._path("autosave_path")
        try:
            self._save_all(path)
        except (VliError, TimeoutError) as error:
            self.get_logger().error(f"automatic save: {error}", throttle_duration_sec=60.0)
        finally:
            self._autosave_started.release()

    def _save_all(self, path: Path) -> int:
        """Write all of the map; return how many points it has."""
        snapshot = self._snapshot(path)
        save_map(path, snapshot)
        return len(snapshot)

    def _snapshot(self, path: Path) -> Snapshot:
        light = self.call(self._settled_light)
        snapshot = take(self.mapper.map, light, self.call)
        if not len(snapshot):
            raise OutputError(f"the map is empty, '{path}' is not written")
        return snapshot

    def _settled_light(self) -> Light | None:
        self.mapper.settle()
        return self.mapper.light()

    def _cloud(self, path: Path) -> PointCloud:
        as_seen = self.parameters.config(MappingConfig).colour == AS_SEEN
        snapshot = self._snapshot(path)
        return restore(snapshot).cloud(light=snapshot.light, as_seen=as_seen)

    def _path(self, name: str) -> Path:
        return Path(getattr(self.parameters.config(StoreConfig), name)).absolute()

    def _clear(self) -> str:
        self.call(lambda: self.mapper.reset(self.session))
        return "the map is empty"


def main() -> None:
    """Run the node."""
    sys.exit(run_node(MappingNode))


if __name__ == "__main__":
    main()
