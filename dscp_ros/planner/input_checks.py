"""The gate that every input passes before it is planned from.

Order: finite, frame, names and sizes, range (all four in `msg_adapters`), age, and the stamp moving
forward. The first failure decides the code.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

from geometry_msgs.msg import InertiaStamped
from nav_msgs.msg import Odometry
from sensor_msgs.msg import JointState

from msg_adapters.errors import InputCode, RejectedInputError
from msg_adapters.joint_state import state_from_joint_state
from msg_adapters.layout import StateLayout
from msg_adapters.limits import StateLimits
from msg_adapters.mass import mass_from_inertia
from msg_adapters.odometry import kinematics_from_odometry
from msg_adapters.stamps import (
    nanoseconds_from_seconds,
    seconds_from_nanoseconds,
    stamp_text,
)
from msg_adapters.state import StampedMass, StampedState, state_from_kinematics

FROM_MESSAGE = "message"
FROM_PARAMETER = "parameter"


@dataclass(frozen=True)
class InputSettings:
    """What inputs have to satisfy.

    Attributes:
        frame: Frame of states; None for that of the problem.
        state_max_age_s: Largest age of a state.
        mass_max_age_s: Largest age of a mass message when a state needs it.
        future_tolerance_s: How far a stamp may be ahead of the clock.
        mass_fallback_kg: Mass to use without a fresh mass message; 0 for none.
        limits: Range limits; None for those of the problem's defaults.
    """

    frame: str | None = None
    state_max_age_s: float = 0.5
    mass_max_age_s: float = 2.0
    future_tolerance_s: float = 0.1
    mass_fallback_kg: float = 0.0
    limits: StateLimits | None = None


@dataclass(frozen=True)
class AcceptedState:
    """A state that may be planned from.

    Attributes:
        state: The state.
        mass_source: Where the mass came from if the input itself had none.
    """

    state: StampedState
    mass_source: str | None = None


class InputGate:
    """Checks inputs, remembers the last mass and stamp, counts. For one thread only."""

    def __init__(self, layout: StateLayout) -> None:
        """Start with no memory.

        Args:
            layout: Names and order of the problem's state.
        """
        self._layout = layout
        self._mass: StampedMass | None = None
        self._last_state_ns: int | None = None
        self.received = 0
        self.rejected: Counter[InputCode] = Counter()

    def forget(self) -> None:
        """Forget the last mass and stamp; counters stay."""
        self._mass = None
        self._last_state_ns = None

    def accept_odometry(
        self, message: Odometry, now_ns: int, settings: InputSettings
    ) -> AcceptedState:
        """Check an odometry and complete it with the mass, if the state has one.

        Raises:
            RejectedInputError: Any code of 1xx to 7xx.
        """
        odometry = self._layout.odometry
        assert odometry is not None  # else nobody listens to it
        kinematics = kinematics_from_odometry(
            message, self._layout, frame=settings.frame, limits=settings.limits
        )
        self._check_time("header.stamp", kinematics.stamp_ns, now_ns, settings)
        mass_kg, source = None, None
        if odometry.mass is not None:
            mass_kg, source = self._mass_at(kinematics.stamp_ns, settings)
        state = state_from_kinematics(kinematics, mass_kg, self._layout, limits=settings.limits)
        self._last_state_ns = kinematics.stamp_ns
        return AcceptedState(state, source)

    def accept_joint_state(
        self, message: JointState, now_ns: int, settings: InputSettings
    ) -> AcceptedState:
        """Check a whole state.

        Raises:
            RejectedInputError: Any code of 1xx to 6xx.
        """
        state = state_from_joint_state(
            message, self._layout, frame=settings.frame, limits=settings.limits
        )
        self._check_time("header.stamp", state.stamp_ns, now_ns, settings)
        self._last_state_ns = state.stamp_ns
        return AcceptedState(state)

    def accept_mass(self, message: InertiaStamped, now_ns: int, settings: InputSettings) -> None:
        """Check a mass and remember it.

        Raises:
            RejectedInputError: NOT_FINITE, MASS_NOT_POSITIVE, INVALID_STAMP, STALE_STAMP,
                FUTURE_STAMP or STAMP_BACKWARD.
        """
        mass = mass_from_inertia(message)
        _check_age("header.stamp", mass.stamp_ns, now_ns, settings.mass_max_age_s, settings)
        if self._mass is not None:
            _check_forward("header.stamp", mass.stamp_ns, self._mass.stamp_ns)
        self._mass = mass

    def check_still_fresh(self, state: StampedState, now_ns: int, settings: InputSettings) -> None:
        """Check the age of a state that was accepted earlier.

        Raises:
            RejectedInputError: STALE_STAMP or FUTURE_STAMP.
        """
        _check_age("last state", state.stamp_ns, now_ns, settings.state_max_age_s, settings)

    def _check_time(self, field: str, stamp_ns: int, now_ns: int, settings: InputSettings) -> None:
        _check_age(field, stamp_ns, now_ns, settings.state_max_age_s, settings)
        if self._last_state_ns is not None:
            _check_forward(field, stamp_ns, self._last_state_ns)

    def _mass_at(self, stamp_ns: int, settings: InputSettings) -> tuple[float, str]:
        """Mass to use with a state of the given time, and where it came from."""
        if self._mass is not None:
            age_s = seconds_from_nanoseconds(stamp_ns - self._mass.stamp_ns)
            if age_s <= settings.mass_max_age_s:
                return self._mass.mass_kg, FROM_MESSAGE
        if settings.mass_fallback_kg > 0.0:
            return settings.mass_fallback_kg, FROM_PARAMETER
        if self._mass is None:
            raise RejectedInputError(
                InputCode.MASS_MISSING, "mass", None, "a mass message, or mass_fallback_kg > 0"
            )
        bound = f"<= {settings.mass_max_age_s:g} s, or mass_fallback_kg > 0"
        raise RejectedInputError(InputCode.MASS_STALE, "age of mass", age_s, bound)


def _check_age(
    field: str, stamp_ns: int, now_ns: int, max_age_s: float, settings: InputSettings
) -> None:
    age_ns = now_ns - stamp_ns
    if age_ns > nanoseconds_from_seconds(max_age_s):
        raise _late_or_early(InputCode.STALE_STAMP, field, age_ns, f"<= {max_age_s:g}", now_ns)
    if -age_ns > nanoseconds_from_seconds(settings.future_tolerance_s):
        bound = f">= -{settings.future_tolerance_s:g}"
        raise _late_or_early(InputCode.FUTURE_STAMP, field, age_ns, bound, now_ns)


def _late_or_early(
    code: InputCode, field: str, age_ns: int, bound: str, now_ns: int
) -> RejectedInputError:
    age_s = seconds_from_nanoseconds(age_ns)
    return RejectedInputError(
        code, f"age of {field}", age_s, f"{bound} s at clock time {stamp_text(now_ns)} s"
    )


def _check_forward(field: str, stamp_ns: int, last_ns: int) -> None:
    if stamp_ns <= last_ns:
        raise RejectedInputError(
            InputCode.STAMP_BACKWARD,
            field,
            seconds_from_nanoseconds(stamp_ns),
            f"> {stamp_text(last_ns)} s, the last accepted",
        )
