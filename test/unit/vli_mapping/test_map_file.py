from __future__ import annotations

import errno
import io
import json
import zipfile
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mapping_scenes import calibration, looking_down, sheet, stripe

from vli_common.errors import InputError, OutputError
from vli_mapping.features import DESCRIPTOR_BYTES
from vli_mapping.keyframe import MapKeyframe
from vli_mapping.light import Light
from vli_mapping.map_file import load_map, save_map
from vli_mapping.mapper import Mapper
from vli_mapping.point_map import Columns, PointMap
from vli_mapping.snapshot import CHUNK_ROWS, Snapshot, restore, take

LIGHT = Light(np.array([0.001, -0.006, -0.004]), 0.06, (0.2, -0.03), 0.0283)


@pytest.fixture
def snapshot() -> Snapshot:
    point_map = PointMap()
    sheet(point_map, rows=20)
    point_map.refine_normals(point_map.alive(), np.array([0, 0, 1.0]))
    point_map.keyframes.extend(keyframe(seed) for seed in range(3))
    c, told = point_map.columns, slice(0, point_map.rows, 2)
    c.albedo[told], c.albedo_weight[told], c.albedo_power[told] = [90.0, 120.0, 60.0], 2.0, 9000.0
    return take(point_map, LIGHT)


def keyframe(seed: int) -> MapKeyframe:
    """Return a view of 30 + ``seed`` features; the second is of a camera with smaller images."""
    rng, count = np.random.default_rng(seed), 30 + seed
    descriptors = rng.integers(0, 256, (count, DESCRIPTOR_BYTES), dtype=np.uint8)
    thumbnail = rng.integers(0, 256, (120 - 20 * (seed == 1), 160), dtype=np.uint8)
    return MapKeyframe(looking_down(0.01 * seed, 0.0), 0.03, rng.normal(size=(count, 3)), descriptors, thumbnail)


def assert_same(one: Snapshot, two: Snapshot) -> None:
    assert len(one.keyframes) == len(two.keyframes)
    for first, second in zip(one.keyframes, two.keyframes, strict=True):
        for item in fields(MapKeyframe):
            np.testing.assert_array_equal(getattr(first, item.name), getattr(second, item.name))
    for item in fields(Columns):
        np.testing.assert_array_equal(getattr(one.columns, item.name), getattr(two.columns, item.name))
    np.testing.assert_array_equal(one.views, two.views)


def test_a_map_is_loaded_as_it_was_saved(snapshot: Snapshot, tmp_path: Path) -> None:
    save_map(tmp_path / "map.vli", snapshot)
    back = load_map(tmp_path / "map.vli")
    assert_same(back, snapshot)
    assert back.light is not None
    np.testing.assert_array_equal(back.light.position, LIGHT.position)
    assert replace(back.light, position=LIGHT.position) == LIGHT
    assert [path.name for path in tmp_path.iterdir()] == ["map.vli"]


@pytest.mark.parametrize(("version", "lacking"), [(1, ("albedo", "keyframe")), (2, ("albedo",))])
def test_a_map_of_a_version_before_lacks_what_came_later(
    snapshot: Snapshot, tmp_path: Path, version: int, lacking: tuple[str, ...]
) -> None:
    save_map(tmp_path / "map.vli", snapshot)
    change = header(version=version)
    rewrite(tmp_path / "map.vli", lambda name, data: None if name.startswith(lacking) else change(name, data))
    back = load_map(tmp_path / "map.vli")
    for name in ("albedo", "albedo_weight", "albedo_power"):
        assert not getattr(back.columns, name).any()
        getattr(snapshot.columns, name)[:] = 0
    assert_same(back, replace(snapshot, keyframes=() if version == 1 else snapshot.keyframes))


def test_the_same_map_is_the_same_file(snapshot: Snapshot, tmp_path: Path) -> None:
    for name in ("a.vli", "b.vli"):
        save_map(tmp_path / name, snapshot)
    assert (tmp_path / "a.vli").read_bytes() == (tmp_path / "b.vli").read_bytes()


def test_an_empty_map_is_a_map(tmp_path: Path) -> None:
    save_map(tmp_path / "map.vli", take(PointMap(), None))
    back = load_map(tmp_path / "map.vli")
    assert len(back) == 0
    assert back.light is None
    assert len(restore(back)) == 0


def test_a_restored_map_merges_and_finds_as_the_old_one_does(snapshot: Snapshot) -> None:
    old, new = PointMap(), restore(snapshot)
    sheet(old, rows=20)
    again = stripe(np.array([[3e-4, 6e-4, 2e-5], [1.0, 1.0, 1.0]]), number=40)
    np.testing.assert_array_equal(old.insert(again), new.insert(again))
    np.testing.assert_array_equal(old.columns.position[: old.rows], new.columns.position[: new.rows])
    assert new.columns.weight[:400].max() == 2


def test_points_that_left_are_not_in_the_file(tmp_path: Path) -> None:
    point_map = PointMap()
    flying = np.array([[0, 0, 1e-4], [5e-3, 0, 0]])
    point_map.insert(stripe(flying, 0, solid=np.zeros(2, np.bool_)))
    point_map.insert(stripe(np.array([[0.0, 0.0, 0.0]]), 1))
    assert point_map.rows == 2
    assert len(take(point_map, None)) == len(point_map) == 2
    np.testing.assert_allclose(take(point_map, None).columns.position, [[0, 0, 0], [5e-3, 0, 0]])


def test_a_map_that_grows_while_it_is_copied_is_copied_in_steps_and_whole() -> None:
    point_map = PointMap()
    x = np.arange(CHUNK_ROWS) * 3e-4
    row = np.stack([x, np.zeros_like(x), np.zeros_like(x)], axis=1)
    point_map.insert(stripe(row, 0))
    steps = 0

    def exclusively(step: Callable[[], Any]) -> Any:
        nonlocal steps
        steps += 1
        if steps == 2:
            point_map.insert(stripe(row + np.array([0, 1e-3, 0]), 1))
        return step()

    snapshot = take(point_map, None, exclusively)
    assert steps > 4
    assert len(snapshot) == 2 * CHUNK_ROWS
    np.testing.assert_array_equal(np.unique(snapshot.columns.scan), [0, 1])


def rewrite(path: Path, change: Callable[[str, bytes], bytes | None]) -> None:
    """Replace each entry of a zip by ``change``; None leaves it out."""
    with zipfile.ZipFile(path) as archive:
        entries = {name: change(name, archive.read(name)) for name in archive.namelist()}
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in entries.items():
            if data is not None:
                archive.writestr(name, data)


def header(**changes: object) -> Callable[[str, bytes], bytes]:
    return lambda name, data: json.dumps(json.loads(data) | changes).encode() if name == "header.json" else data


def column(name: str, change: Callable[[Any], Any]) -> Callable[[str, bytes], bytes]:
    """Return a rewriting that changes the values of one column, whose type and shape stay."""

    def rewritten(entry: str, data: bytes) -> bytes:
        if entry != f"{name}.npy":
            return data
        values = np.load(io.BytesIO(data))
        stream = io.BytesIO()
        np.save(stream, np.ascontiguousarray(change(values)).view(values.dtype))
        return stream.getvalue()

    return rewritten


def claim(name: str, length: object) -> Callable[[str, bytes], bytes]:
    """Return a rewriting after which one column says that it has this many rows."""

    def rewritten(entry: str, data: bytes) -> bytes:
        if entry != f"{name}.npy":
            return data
        head = f"{{'descr': '<f4', 'fortran_order': False, 'shape': ({length},), }}".encode().ljust(117) + b"\n"
        return b"\x93NUMPY\x01\x00" + len(head).to_bytes(2, "little") + head + b"xxxx"

    return rewritten


def compress(path: Path) -> None:
    with zipfile.ZipFile(path) as archive:
        entries = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in entries.items():
            archive.writestr(name, data, zipfile.ZIP_STORED if name == "header.json" else zipfile.ZIP_DEFLATED)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda path: path.unlink(), "cannot be read: No such file"),
        (lambda path: path.write_bytes(b"ply\nformat ascii 1.0\n"), "no map or a damaged one.*vli run"),
        (lambda path: path.write_bytes(b""), "no map or a damaged one"),
        (lambda path: path.write_bytes(path.read_bytes()[:-1000]), "no map or a damaged one"),
        (lambda path: rewrite(path, lambda name, data: None if name == "header.json" else data), "no 'header.json'"),
        (lambda path: rewrite(path, header(format="other")), "does not say 'vli-map'"),
        (lambda path: rewrite(path, header(version=99)), "version '99', this program reads '1' to '3'"),
        (lambda path: rewrite(path, header(points=7)), "do not belong together"),
        (lambda path: rewrite(path, lambda name, data: None if "descriptors" in name else data), "damaged.*descriptors"),
        (lambda path: rewrite(path, column("albedo_weight", lambda values: -values)), "damaged.*nowhere, or look like nothing"),
        (
            lambda path: rewrite(path, column("albedo", lambda values: np.full_like(values, np.inf))),
            "damaged.*nowhere, or look like nothing",
        ),
        (lambda path: rewrite(path, column("keyframe_poses", lambda values: 2 * values)), "damaged.*keyframes are nowhere"),
        (lambda path: rewrite(path, column("keyframe_points", lambda values: np.nan * values)), "damaged.*keyframes are nowhere"),
        (lambda path: rewrite(path, column("keyframe_depths", lambda values: -values)), "damaged.*keyframes are nowhere"),
        (lambda path: rewrite(path, column("keyframe_sizes", lambda values: values + 1)), "damaged.*belong to their features"),
        (lambda path: rewrite(path, column("keyframe_sizes", lambda values: -values)), "damaged.*do not belong together"),
        (lambda path: rewrite(path, column("keyframe_shapes", lambda values: values * 10**9)), "damaged.*more than there is"),
        (lambda path: rewrite(path, header(light={"position": [0]})), "damaged"),
        (lambda path: rewrite(path, lambda name, data: None if name == "colour.npy" else data), "damaged.*colour"),
        (lambda path: rewrite(path, lambda name, data: b"junk" if name == "colour.npy" else data), "damaged"),
        (lambda path: rewrite(path, lambda name, data: data[:-40] if name == "sigma.npy" else data), "damaged"),
        (lambda path: rewrite(path, column("position", lambda values: values * 1e300)), "points that are nowhere"),
        (lambda path: rewrite(path, column("sigma", lambda values: values * np.float32("nan"))), "points that are nowhere"),
        (lambda path: rewrite(path, column("solid", lambda values: values.view(np.uint8) * 0 + np.uint8(170))), "nowhere"),
        (lambda path: rewrite(path, claim("weight", 10**12)), r"'weight' is 'float32\[1000000000000\]', which is not what its"),
        (lambda path: rewrite(path, claim("weight", "(")), "damaged"),
        (lambda path: rewrite(path, header(light=None, points=2)), "do not belong together"),
        (lambda path: rewrite(path, header(origin="x" * 70_000)), "header is compressed, or has"),
        (lambda path: rewrite(path, lambda name, data: b"[" * 60_000 if name == "header.json" else data), "damaged"),
        (compress, "is compressed"),
    ],
)
def test_a_file_that_is_no_map_is_one_clear_line(
    snapshot: Snapshot, tmp_path: Path, damage: Callable[[Path], None], message: str
) -> None:
    path = tmp_path / "map.vli"
    save_map(path, snapshot)
    damage(path)
    with pytest.raises(InputError, match=message) as caught:
        load_map(path)
    assert "\n" not in str(caught.value)


def test_one_flipped_bit_is_noticed(snapshot: Snapshot, tmp_path: Path) -> None:
    path = tmp_path / "map.vli"
    save_map(path, snapshot)
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 4
    path.write_bytes(data)
    with pytest.raises(InputError, match=r"map\.vli"):
        load_map(path)


def test_a_file_whose_entry_names_itself_by_half_the_file_is_one_short_line(snapshot: Snapshot, tmp_path: Path) -> None:
    path = tmp_path / "map.vli"
    save_map(path, snapshot)
    with zipfile.ZipFile(path) as archive:
        start = archive.getinfo("position.npy").header_offset
    content = bytearray(path.read_bytes())
    content[start + 26 : start + 28] = (5000).to_bytes(2, "little")
    path.write_bytes(content)
    with pytest.raises(InputError, match="is no map or a damaged one") as caught:
        load_map(path)
    assert len(str(caught.value)) < 250 + len(str(path))


def test_an_array_of_objects_is_never_unpickled(snapshot: Snapshot, tmp_path: Path) -> None:
    path = tmp_path / "map.vli"
    save_map(path, snapshot)
    objects = tmp_path / "objects.npy"
    np.save(objects, np.array([{}], object), allow_pickle=True)
    rewrite(path, lambda name, data: objects.read_bytes() if name == "colour.npy" else data)
    with pytest.raises(InputError, match="damaged"):
        load_map(path)


def test_a_full_disk_leaves_the_old_file_and_the_map(snapshot: Snapshot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "map.vli"
    save_map(path, snapshot)
    before = path.read_bytes()

    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("numpy.lib.format.write_array", full)
    with pytest.raises(OutputError, match=r"map\.vli' cannot be written: No space left"):
        save_map(path, snapshot)
    assert path.read_bytes() == before
    assert [item.name for item in tmp_path.iterdir()] == ["map.vli"]


def test_scans_do_not_enter_a_map_of_an_earlier_session_until_the_mapper_is_reset(snapshot: Snapshot) -> None:
    from test_mapper import run

    mapper = Mapper(calibration())
    mapper.adopt(snapshot)
    before = len(mapper.map)
    run(mapper, 0, 41)
    assert len(mapper.map) == before
    assert not mapper.is_located
    assert mapper.light() is LIGHT
    mapper.reset(1)
    assert mapper.counters["scans_unlocated"] == 20
    run(mapper, 0, 41, session=1)
    assert mapper.counters["scans_entered"] == 20
