"""One view that the map remembers."""

from __future__ import annotations

from dataclasses import dataclass, replace

from vli_common.arrays import ByteArray, FloatArray
from vli_common.geometry import transform


@dataclass(frozen=True, slots=True)
class MapKeyframe:
    """One view of the map.

    Args:
        T_map_camera: (4, 4).
        depth: metres, median distance of the surface along the optical axis.
        points: (N, 3) float64, map, where the features are.
        descriptors: (N, 32) uint8, the strongest first, see ``features``.
        thumbnail: (H, W) uint8, see ``features``.
    """

    T_map_camera: FloatArray
    depth: float
    points: FloatArray
    descriptors: ByteArray
    thumbnail: ByteArray

    def __len__(self) -> int:
        return len(self.points)

    def moved(self, T: FloatArray) -> MapKeyframe:
        """Return the keyframe in another frame, to which ``T`` (4, 4) maps."""
        return replace(self, T_map_camera=T @ self.T_map_camera, points=transform(T, self.points))
