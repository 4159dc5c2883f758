"""``vli export``: a saved map to the formats of other programs, as a cloud or as a mesh."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from vli_common.errors import InputError, OutputError
from vli_common.ply import read_cloud
from vli_common.types import PointCloud
from vli_mapping.albedo import finished_cloud
from vli_mapping.config import AS_SEEN, COMPENSATED
from vli_mapping.export import CLOUD_WRITERS, write_cloud
from vli_mapping.map_file import SUFFIX, load_map
from vli_mapping.mesh import MESH_SUFFIXES, VOXEL_M, make_mesh, write_mesh
from vli_mapping.snapshot import restore
from vli_mapping.store import check_place

_MM = 1e-3


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``vli export``."""
    parser.add_argument("map", metavar="MAP", type=Path, help=f"results of 'vli run', or a map file ({SUFFIX} or .ply)")
    parser.add_argument("--out", metavar="F", type=Path, required=True, help="file to write; its ending names the format")
    parser.add_argument("--mesh", action="store_true", help="a mesh, where the ending (.ply) does not tell")
    parser.add_argument("--voxel", metavar="MM", type=float, default=VOXEL_M / _MM, help="of the mesh (default: %(default)s mm)")
    parser.add_argument(
        "--colour", choices=(COMPENSATED, AS_SEEN), help="without the light on board (default), or as seen; of a .vli map"
    )


def run(args: argparse.Namespace) -> int:
    """Export; return 0.

    Raises:
        VliError: the map cannot be read, the format is unknown, a library is missing, or the file cannot be written.
    """
    suffix = args.out.suffix.lower()
    if suffix not in (*CLOUD_WRITERS, *MESH_SUFFIXES) or (args.mesh and suffix not in MESH_SUFFIXES):
        valid = MESH_SUFFIXES if args.mesh else dict.fromkeys([*CLOUD_WRITERS, *MESH_SUFFIXES])
        raise OutputError(f"'{args.out}' ends in '{args.out.suffix}', expected one of {', '.join(valid)}")
    if not 0.01 <= args.voxel <= 10:
        raise InputError(f"--voxel is '{args.voxel:g}', expected 0.01 to 10 mm")
    check_place(args.out)
    cloud = read_map(args.map, args.colour)
    if not len(cloud):
        raise InputError(f"map '{args.map}' is empty, there is nothing to export")
    if args.mesh or suffix not in CLOUD_WRITERS:
        mesh = make_mesh(cloud, args.voxel * _MM)
        write_mesh(args.out, mesh)
        sys.stdout.write(f"{len(mesh.vertices)} vertices, {len(mesh.faces)} triangles in '{args.out}'\n")
    else:
        write_cloud(args.out, cloud)
        sys.stdout.write(f"{len(cloud)} points in '{args.out}'\n")
    return 0


def read_map(path: Path, colour: str | None = None) -> PointCloud:
    """Return the points of a map file, or of the one in a directory of results.

    Args:
        path: ``.vli``, ``.ply``, or a directory that holds one of them as ``map``.
        colour: see ``mapping.colour``; None is its default, or what the PLY has.

    Raises:
        InputError: there is no map, or ``colour`` is asked of a PLY, which has but one.
    """
    if path.is_dir():
        here = [path / f"map{suffix}" for suffix in (SUFFIX, ".ply")]
        path = next((item for item in here if item.is_file()), here[0])
    if path.suffix.lower() == ".ply":
        if colour is not None:
            raise InputError(
                f"'{path}' has its colours as they are, --colour needs the map that 'vli run' writes as 'map{SUFFIX}'"
            )
        return read_cloud(path)
    snapshot = load_map(path)
    return finished_cloud(restore(snapshot), snapshot.light, colour == AS_SEEN)
