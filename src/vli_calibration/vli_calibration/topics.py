"""``--topic image=/x``: the names of a bag's topics, as ``vli run`` takes them."""

from __future__ import annotations

import argparse

from vli_driver.bag import DEFAULT_IMAGE_TOPIC, DEFAULT_IMU_TOPIC

DEFAULTS = {"image": DEFAULT_IMAGE_TOPIC, "imu": DEFAULT_IMU_TOPIC}


def add_topic_argument(parser: argparse.ArgumentParser, *kinds: str) -> None:
    """Add ``--topic``; ``kinds`` (``image``, ``imu``) are the topics that the command reads. :func:`topic` has the answer."""

    def read(text: str) -> tuple[str, str]:
        kind, _, name = text.partition("=")
        if kind not in kinds or not name.startswith("/"):
            raise argparse.ArgumentTypeError(f"'{text}', expected {' or '.join(f'{item}=/name' for item in kinds)}")
        return kind, name

    usual = ", ".join(f"{kind}={DEFAULTS[kind]}" for kind in kinds)
    parser.add_argument(
        "--topic", action="append", default=[], type=read, metavar="NAME=/TOPIC", help=f"of the bag, where not {usual}"
    )


def topic(args: argparse.Namespace, kind: str) -> str:
    """Return the name of a topic: as given, or the usual one."""
    named: dict[str, str] = dict(args.topic)
    return named.get(kind, DEFAULTS[kind])
