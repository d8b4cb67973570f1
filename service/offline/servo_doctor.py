"""Diagnosis of a serial line: its servos, and whether the scene's servo is among them."""

from __future__ import annotations

from dataclasses import dataclass

from devices.buses.device_users import find_programs_using
from devices.buses.serial_line import check_latency_timer, find_stable_path, read_latency_timer_ms
from devices.chips.dynamixel.servo_search import BAUDRATES, FoundServo, find_servos
from devices.clock import Clock
from devices.errors import ServoSetupError
from devices.scene.hardware_sections import ServoSection

TIMEOUTS_S = (0.05, 0.25)
"""Response timeouts; the second one is used if no servo answered, because a busy machine may read
late, and a working servo must not be reported as missing."""


@dataclass(frozen=True)
class ServoDiagnosis:
    """Result of a serial line's diagnosis.

    Attributes:
        found: every servo that answered.
        latency_timer_ms: latency timer of the adapter; None if it has none.
        is_well: True if the expected servo is present with the scene's settings, and the adapter
            is fast.
        verdict: summary in a few sentences, with advice.
    """

    found: tuple[FoundServo, ...]
    latency_timer_ms: int | None
    is_well: bool
    verdict: str


def diagnose_servo(port: str, clock: Clock, expected: ServoSection | None) -> ServoDiagnosis:
    """Search for a servo in both protocols at the usual baud rates.

    Args:
        port: serial port.
        clock: a real clock.
        expected: the scene's servo; None: any with id 1.
    """
    servo_id = expected.id if expected is not None else 1
    rates = dict.fromkeys((*((expected.baudrate,) if expected is not None else ()), *BAUDRATES))
    found: tuple[FoundServo, ...] = ()
    try:
        for timeout_s in TIMEOUTS_S:
            found = found or tuple(
                find_servos(port, clock, servo_ids=[servo_id], baudrates=rates, timeout_s=timeout_s)
            )
    except ServoSetupError as error:
        holders = ", ".join(find_programs_using(port))
        held = f" It is open in {holders}." if holders else ""
        return ServoDiagnosis((), None, is_well=False, verdict=f"{error}.{held}")
    found_texts = [
        f"{servo.model or f'model {servo.model_number}'}, protocol {servo.protocol}, "
        f"{servo.baudrate} baud, id {servo.servo_id}."
        for servo in found
    ]
    wrong = []
    if not found:
        wrong.append(
            f"No servo answers as id {servo_id}. Check power, cable and id; an MX leaves the "
            "factory with id 1 at 57600 baud."
        )
    elif expected is not None and not any(_is_expected(servo, expected) for servo in found):
        wrong.append(
            f"The scene says {expected.model}, protocol {expected.protocol}, "
            f"{expected.baudrate} baud: change the scene's [servo], or the servo."
        )
    if remark := check_latency_timer(port):
        wrong.append(remark)
    if (lasting := find_stable_path(port)) != port:
        found_texts.append(
            f"Name it {lasting} in the scene: {port} may be another adapter's next time."
        )
    return ServoDiagnosis(
        found, read_latency_timer_ms(port), not wrong, " ".join((*found_texts, *wrong))
    )


def _is_expected(servo: FoundServo, wanted: ServoSection) -> bool:
    return (servo.model, servo.protocol, servo.baudrate) == (
        wanted.model,
        wanted.protocol,
        wanted.baudrate,
    )
