"""What a running scan says: map, newest stripes, path, camera, and every node's state in words."""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np

from vli_bringup.viewing.map_display import MapDisplay
from vli_bringup.viewing.scene import Rgb, Scene
from vli_common.arrays import FloatArray
from vli_common.status import Health, StageStatus
from vli_common.types import PointCloud

STRIPES, UPDATES, PATH, CAMERA = "/stripes", "/updates", "/path", "/camera"
_STRIPE_FACTOR = 2.0
"""The newest stripes have larger points than the map."""
_UPDATES = 120
"""Updates that wait for the next whole map; at three keyframes a second and a map every 2 s, a few would do."""
_PATH_RGB: Rgb = (230, 120, 20)
_CAMERA_M = 5e-3
_MARKS = {Health.OK: "✓", Health.WARN: "!", Health.ERROR: "✗", Health.STALE: "?"}


class LiveDisplay:
    """Shows what comes; a new session clears the scene.

    Args:
        scene: to show it in.
    """

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        with scene.gui.add_folder("State"):
            self.text = scene.gui.add_markdown("waiting for nodes: nothing has come yet")
        self._map = MapDisplay(scene)
        self._statuses: dict[str, StageStatus] = {}
        self._updates: deque[Any] = deque()
        self._handles: dict[str, Any] = {}
        self._numbers = 0
        self._session: int | None = None
        self._is_placed = False

    def add_map(self, cloud: PointCloud) -> None:
        """Take the whole map; it has in it what the updates before said."""
        self._begin(cloud.session)
        self._map.show(cloud)
        while self._updates:
            self._updates.popleft().remove()
        self._place(cloud, is_whole=True)

    def add_update(self, cloud: PointCloud) -> None:
        """Take points that are new in the map."""
        self._begin(cloud.session)
        if not len(cloud):
            return
        self._numbers += 1
        self._updates.append(self._scene.cloud(f"{UPDATES}/{self._numbers}", cloud.points, cloud.colours, self._map.size_m))
        if len(self._updates) > _UPDATES:
            self._updates.popleft().remove()
        self._place(cloud)

    def add_stripes(self, cloud: PointCloud) -> None:
        """Take the newest coloured stripes."""
        self._begin(cloud.session)
        self._handles[STRIPES] = self._scene.cloud(STRIPES, cloud.points, cloud.colours, _STRIPE_FACTOR * self._map.size_m)
        self._place(cloud)

    def add_path(self, poses: FloatArray) -> None:
        """Take the path so far: T_map_imu (N, 4, 4)."""
        if len(poses) > 1:
            self._handles[PATH] = self._scene.path(PATH, poses[:, :3, 3], _PATH_RGB)

    def add_pose(self, T_map_camera: FloatArray) -> None:
        """Take where the camera is now (4, 4)."""
        self._handles[CAMERA] = self._scene.cameras(CAMERA, T_map_camera[None], _PATH_RGB, _CAMERA_M)

    def add_status(self, status: StageStatus) -> None:
        """Take what a node says of itself."""
        self._statuses[status.node] = status
        self.text.content = status_text(self._statuses)

    def _begin(self, session: int) -> None:
        """Clear what another session has left."""
        if self._session not in (None, session):
            for handle in (*self._handles.values(), *self._updates):
                handle.remove()
            self._handles.clear()
            self._updates.clear()
            empty = np.empty((0, 3), np.float32)
            self._map.show(PointCloud(0, empty, empty.astype(np.uint8), session=session))
        self._session = session

    def _place(self, cloud: PointCloud, is_whole: bool = False) -> None:
        """Look at the first that comes; a map that has grown is for the browsers that come later."""
        if len(cloud) and (is_whole or not self._is_placed):
            self._scene.look_at(cloud.points, move=not self._is_placed)
            self._is_placed = True


def status_text(statuses: dict[str, StageStatus]) -> str:
    """Return the states of the nodes in words, in Markdown: first what a user is to do, then a line a node."""
    lines = []
    for status in statuses.values():
        if "tracking" in status.values:
            lines.append(f"## {status.values['tracking']}")
            lines.append(status.values.get("reason", ""))
    for name, status in sorted(statuses.items()):
        said = f": {status.hint}" if status.hint else ""
        latency = status.values.get("latency_p50_ms")
        cost = f" ({latency} ms)" if latency else ""
        lines.append(f"- {_MARKS[status.health]} **{name}** {status.state.value}{cost}{said}")
    return "\n\n".join(line for line in lines if line)
