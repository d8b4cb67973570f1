"""Speed of tracking in a film of 1080p: pictures a second and per second of one core's time.

    python benchmarks/video.py [--pictures 150]

A film of each kind (H.264; tags, dots) is rendered, decoded alone, then decoded and tracked, all on
one core; OpenCV has one thread.
"""

from __future__ import annotations

import argparse
import math
import os
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from service.video.container import iterate_pictures, read_film
from service.video.tracking import make_dot_finder, make_tag_finder, track_markers
from studies.reproduce.leg_film import LOWER_TAG, UPPER_TAG, Camera, film_leg, write_film


def decode(path: Path) -> None:
    for _ in iterate_pictures(path, is_grey=True):
        pass


def show_speed(what: str, pictures: int, run: Callable[[], object]) -> None:
    began_s, cpu_s = time.perf_counter(), time.process_time()
    run()
    took_s, cpu_s = time.perf_counter() - began_s, time.process_time() - cpu_s
    print(
        f"{what:<16} {pictures / took_s:7.1f} pictures/s, {pictures / cpu_s:7.1f} per core second"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--pictures", type=int, default=150)
    count = parser.parse_args().pictures
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    cv2.setNumThreads(1)
    camera = Camera(width=1920, height=1080)
    begin_s = [i / camera.rate_hz for i in range(count)]
    with tempfile.TemporaryDirectory() as work:
        for marks in ("tags", "dots"):
            pictures = film_leg(
                camera,
                begin_s,
                lambda t_s: 0.3 * math.sin(5.0 * t_s),
                np.random.default_rng(1),
                marks=marks,
            )
            path = write_film(Path(work) / f"{marks}.mp4", camera, pictures, begin_s)
            show_speed("decoding", count, partial(decode, path))
            film, _ = read_film(path)
            find = (
                make_tag_finder(LOWER_TAG, UPPER_TAG)
                if marks == "tags"
                else make_dot_finder("bright", film)
            )
            track = partial(track_markers, path, film, find, is_grey=True)
            show_speed(f"with {marks}", count, track)


if __name__ == "__main__":
    main()
