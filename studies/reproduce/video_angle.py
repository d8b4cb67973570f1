"""Angle of `rolling` by a camera, as in the paper, and what that costs beside the servo.

The trial runs in virtual time, so its true angle is known at each instant. A film of two tags along
the leg is rendered from it and deleted afterwards; from there on all is as for a real film.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from devices.arrays import Floats
from devices.errors import require_extra
from devices.scene.scene_file import Scene
from service.estimation import OFFLINE_LAG_MS
from service.estimation.calibration import Calibration
from service.offline.estimate.preparation import EstimateRequest
from service.offline.estimate.session import estimate_session
from service.offline.estimate.table_angle import read_angle_track
from service.offline.simulation import SimulationOptions, run_simulation
from service.rig.emulated_foot import EmulatedFoot
from service.video.alignment import fit_alignment
from service.video.angle import TrackOptions, track_video
from service.video.worker import describe_film
from storage.formats.angle_table import ANGLE_NAME
from storage.sessions.folder import FRAMES_NAME
from storage.sessions.reader import SealedFileReader
from storage.sessions.videos import IncomingVideo, find_video_folder, write_video

SERVO, VIDEO = "servo", "video"
_COLUMNS = ("t_ns", "angle_rad", "true_angle_rad", "true_force_n", "true_cop_x_m", "cop_ground_x_m")
_STAMP_SIGMA_NS = 1e5
"""Stated uncertainty of the film's time in the session, which is exact here."""


@dataclass(frozen=True)
class AngleComparison:
    """Angle and COP on the ground by servo and by video, against the truth.

    Attributes:
        pictures: number of pictures of the film.
        rate_hz: its pictures per second.
        angle_rms_rad: root mean square error of the angle, by source.
        angle_most_rad: greatest error.
        cop_rms_m: root mean square error of the COP forward on the ground.
        cop_apart_m: greatest difference between both.
    """

    pictures: int
    rate_hz: float
    angle_rms_rad: Mapping[str, float]
    angle_most_rad: Mapping[str, float]
    cop_rms_m: Mapping[str, float]
    cop_apart_m: float


def compare_angle_sources(
    scene: Scene, calibration: Calibration, *, seconds: float, seed: int, parts_seed: int
) -> AngleComparison:
    """Roll the foot, film it, and estimate with the angle of each source.

    Raises:
        FootTileError: the trial or its film fails, or the extra `video` is not installed.
    """
    with require_extra("video", "the angle from video"):
        from studies.reproduce.leg_film import LOWER_TAG, UPPER_TAG, Camera, film_leg, write_film
    camera = Camera()
    with tempfile.TemporaryDirectory(prefix="foottile-film-") as work:
        folder = Path(work)
        recording = folder / FRAMES_NAME
        foot = EmulatedFoot(seed=seed, parts_seed=parts_seed)
        run_simulation(
            SimulationOptions(scene, seconds, with_truth=True, foot=foot), recording, None
        )
        truth = _read(recording, ("t_ns", "true_angle_rad"))
        t_s = (truth["t_ns"] - truth["t_ns"][0]) * 1e-9
        begin_s = np.arange(0.0, t_s[-1], 1.0 / camera.rate_hz)
        angle_at = partial(np.interp, xp=t_s, fp=truth["true_angle_rad"])
        pictures = film_leg(camera, begin_s.tolist(), angle_at, np.random.default_rng(seed))
        path = write_film(folder / "leg.mp4", camera, pictures, begin_s.tolist())
        with IncomingVideo(folder, path.name) as incoming:
            incoming.write(path.read_bytes())
            video = incoming.keep(lambda kept: describe_film(kept, path.name))
        place = find_video_folder(folder, video.id)
        exposed_ns = 0.5e9 * camera.exposure / camera.rate_hz
        alignment = fit_alignment(
            "hand",
            np.zeros(1),
            np.array([exposed_ns]),
            np.array([_STAMP_SIGMA_NS]),
            begin_t_ns=int(truth["t_ns"][0]),
        )
        video = video.model_copy(update={"alignment": alignment})
        write_video(place, video)
        tracked = track_video(place, video, TrackOptions(tags=(LOWER_TAG, UPPER_TAG)))
        tracked.table.write(place / ANGLE_NAME)
        track = read_angle_track(place / ANGLE_NAME)
        request = EstimateRequest(calibration, None, OFFLINE_LAG_MS, scene, None)
        found = {}
        for source, angle in ((SERVO, None), (VIDEO, track)):
            out = folder / f"{source}.parquet"
            estimate_session(
                recording, out, request, on_remark=lambda _: None, with_findings=False, angle=angle
            )
            found[source] = _read(out, _COLUMNS)
        z_m = np.array([tile.z_m for tile in scene.tile])
    return _compare(found, z_m, _get_travel(scene), len(pictures), camera.rate_hz)


def _read(path: Path, names: tuple[str, ...]) -> dict[str, Floats]:
    with SealedFileReader(path) as session:
        pieces = list(session.read_quantities(*names))
    return {name: np.concatenate([piece[name] for piece in pieces]) for name in names}


def _get_travel(scene: Scene) -> float:
    assert scene.servo is not None  # noqa: S101
    return scene.servo.ankle_travel_m_per_rad or 0.0


def _compare(
    found: Mapping[str, Mapping[str, Floats]],
    z_m: Floats,
    travel_m_per_rad: float,
    pictures: int,
    rate_hz: float,
) -> AngleComparison:
    true = found[SERVO]
    angle_rad = true["true_angle_rad"]
    with np.errstate(invalid="ignore"):
        true_z_m = true["true_force_n"] @ z_m / true["true_force_n"].sum(axis=1)
    true_m = travel_m_per_rad * angle_rad
    true_m = true_m + true["true_cop_x_m"] * np.cos(angle_rad) + true_z_m * np.sin(angle_rad)
    off_rad = {source: one["angle_rad"] - angle_rad for source, one in found.items()}
    # Only where both are known: the film begins and ends within the trial.
    is_known = np.all([np.isfinite(one) for one in off_rad.values()], axis=0)
    on_ground = np.all([np.isfinite(one["cop_ground_x_m"]) for one in found.values()], axis=0)
    cop_m = {source: one["cop_ground_x_m"][on_ground] for source, one in found.items()}

    def rms(values: Floats) -> float:
        return float(np.sqrt(np.nanmean(values**2)))

    return AngleComparison(
        pictures=pictures,
        rate_hz=rate_hz,
        angle_rms_rad={source: rms(one[is_known]) for source, one in off_rad.items()},
        angle_most_rad={
            source: float(np.abs(one[is_known]).max()) for source, one in off_rad.items()
        },
        cop_rms_m={source: rms(one - true_m[on_ground]) for source, one in cop_m.items()},
        cop_apart_m=float(np.abs(cop_m[VIDEO] - cop_m[SERVO]).max()),
    )
