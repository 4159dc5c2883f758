"""Tracks, preintegration and scans meet again in the order of their stamps, whatever the order of arrival."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from vli_common.frame_pairing import FramePairing, Item, NoPreintegration
from vli_common.types import FrontEndOutput, LaserScan, Preintegration, Tracks


def tracks(stamp_ns: int) -> Tracks:
    none = np.empty((0, 2))
    return Tracks(stamp_ns, False, False, np.empty(0, np.int64), none, none, none, none[:, 0], none[:, 0], np.empty(0, np.uint8))


def inertial(stamp_ns: int) -> Preintegration:
    return Preintegration(stamp_ns, 0, object())


def names(items: list[Item]) -> list[str]:
    return [
        f"scan {item.stamp_ns}"
        if isinstance(item, LaserScan)
        else f"frame {item.tracks.stamp_ns}" + ("" if item.preintegration else " without")
        for item in items
    ]


def test_a_frame_waits_for_its_preintegration_and_the_other_way_round() -> None:
    pairing = FramePairing()
    assert pairing.add_tracks(tracks(10)) == []
    assert names(pairing.add_preintegration(inertial(10))) == ["frame 10"]
    assert pairing.add_preintegration(inertial(20)) == []
    assert names(pairing.add_tracks(tracks(20))) == ["frame 20"]


def test_a_scan_waits_for_the_first_frame_that_is_younger() -> None:
    pairing = FramePairing()
    assert pairing.add_scan(LaserScan.empty(15)) == []
    pairing.add_preintegration(inertial(10))
    assert names(pairing.add_tracks(tracks(10))) == ["frame 10"]
    pairing.add_preintegration(inertial(20))
    assert names(pairing.add_tracks(tracks(20))) == ["scan 15", "frame 20"]
    assert names(pairing.add_scan(LaserScan.empty(17))) == ["scan 17"]
    assert pairing.counters["scans_late"] == 1


def test_a_frame_that_has_no_preintegration_goes_without() -> None:
    pairing = FramePairing()
    pairing.add_preintegration(NoPreintegration(10))
    assert names(pairing.add_tracks(tracks(10))) == ["frame 10 without"]
    assert pairing.counters.values == {}


def test_a_lost_preintegration_holds_nothing_up_and_is_counted() -> None:
    pairing = FramePairing()
    pairing.add_tracks(tracks(10))
    pairing.add_tracks(tracks(20))
    assert names(pairing.add_preintegration(inertial(20))) == ["frame 10 without", "frame 20"]
    assert pairing.counters.values == {"tracks_without_preintegration": 1}


def test_lost_tracks_hold_nothing_up_and_are_counted() -> None:
    pairing = FramePairing()
    pairing.add_preintegration(inertial(10))
    pairing.add_preintegration(inertial(20))
    assert names(pairing.add_tracks(tracks(20))) == ["frame 20"]
    assert pairing.counters.values == {"preintegration_without_tracks": 1}


def test_frames_do_not_wait_for_ever_nor_do_scans_pile_up() -> None:
    pairing = FramePairing()
    released = [item for stamp in range(100) for item in pairing.add_tracks(tracks(stamp))]
    assert len(released) == 40
    for stamp in range(1000, 2000):
        pairing.add_scan(LaserScan.empty(stamp))
    assert len(pairing.flush()) == 600
    assert pairing.counters["scans_without_frame"] == 400


def test_a_new_session_begins_with_nothing() -> None:
    pairing = FramePairing()
    pairing.add_tracks(tracks(10**9))
    pairing.add_preintegration(inertial(10**9))
    pairing.clear()
    pairing.add_scan(LaserScan.empty(5))
    pairing.add_tracks(tracks(10))
    assert names(pairing.add_preintegration(inertial(10))) == ["scan 5", "frame 10"]


@given(st.permutations([("t", i) for i in range(5)] + [("p", i) for i in range(5)]))
def test_any_interleaving_of_the_topics_gives_the_order_of_the_stamps(arrivals: list[tuple[str, int]]) -> None:
    """Each topic keeps its own order; between topics anything goes."""
    order = {"t": iter(range(5)), "p": iter(range(5))}
    pairing, released = FramePairing(), []
    for stamp in range(5):
        pairing.add_scan(LaserScan.empty(10 * stamp + 5))
    for kind, _ in arrivals:
        stamp = 10 * next(order[kind])
        released += pairing.add_tracks(tracks(stamp)) if kind == "t" else pairing.add_preintegration(inertial(stamp))
    stamps = [item.tracks.stamp_ns if isinstance(item, FrontEndOutput) else item.stamp_ns for item in released]
    assert stamps == [0, 5, 10, 15, 20, 25, 30, 35, 40]
    assert all(item.preintegration is not None for item in released if isinstance(item, FrontEndOutput))


def test_a_frame_that_no_front_end_sends_is_dropped() -> None:
    pairing = FramePairing()
    for stamp, expected in ((10, 1), (10, 0), (9, 0), (10 + 11 * 10**9, 0), (20, 1)):
        pairing.add_preintegration(inertial(stamp))
        assert len(pairing.add_tracks(tracks(stamp))) == expected
    assert pairing.counters["tracks_out_of_order"] == 3


def test_what_is_stamped_far_ahead_holds_nothing_up() -> None:
    pairing = FramePairing()
    pairing.add_scan(LaserScan.empty(10**18))
    pairing.add_preintegration(inertial(10**18))
    pairing.add_scan(LaserScan.empty(5))
    pairing.add_preintegration(inertial(10))
    assert names(pairing.add_tracks(tracks(10))) == ["scan 5", "frame 10"]


def test_preintegrations_without_tracks_are_bounded() -> None:
    pairing = FramePairing()
    for stamp in range(1000):
        pairing.add_preintegration(inertial(stamp))
    assert pairing.counters["preintegration_without_tracks"] == 940
