"""Quality of service as bags store it, and as rclpy wants it.

rosbag2's metadata version 9 (Jazzy) writes a YAML list with named values; older versions write the
enum numbers of `rmw/types.h`. Both forms are read, the newer one is written.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any

import yaml

from dscp_core.errors import InvalidInputError

if TYPE_CHECKING:
    from rclpy.qos import QoSProfile

_POLICY_NUMBERS: Mapping[str, Mapping[str, int]] = {
    "history": {"system_default": 0, "keep_last": 1, "keep_all": 2, "unknown": 3},
    "reliability": {
        "system_default": 0,
        "reliable": 1,
        "best_effort": 2,
        "unknown": 3,
        "best_available": 4,
    },
    "durability": {
        "system_default": 0,
        "transient_local": 1,
        "volatile": 2,
        "unknown": 3,
        "best_available": 4,
    },
    "liveliness": {
        "system_default": 0,
        "automatic": 1,
        "manual_by_topic": 3,
        "unknown": 4,
        "best_available": 5,
    },
}
"""Names and numbers of the policies in `rmw/types.h`."""

_DURATIONS = ("deadline", "lifespan", "liveliness_lease_duration")
_INT64_MAX = 2**63 - 1
_NANOSECONDS = 10**9
# What "infinite" looked like in bags of ROS 2 Foxy, per middleware, as (sec, nsec).
_FOXY_INFINITE = {(0x7FFFFFFF, 0xFFFFFFFF), (0x7FFFFFFF, 0x7FFFFFFF)}

DEFAULT_DEPTH = 10
"""History depth where a bag does not know it, as in rosbag2."""


@dataclass(frozen=True)
class Qos:
    """Quality of service of one publisher. The defaults are those of ROS 2.

    Attributes:
        history: `keep_last`, `keep_all`, `system_default` or `unknown` (what discovery reports).
        depth: Messages that `keep_last` keeps.
        reliability: `reliable`, `best_effort`, `system_default`, `unknown` or `best_available`.
        durability: `volatile`, `transient_local` (latched), or as for reliability.
        deadline_ns: 0 means not given, 2^63 - 1 infinite; the same for the other durations.
        lifespan_ns: How long a sent message stays valid.
        liveliness: `automatic`, `manual_by_topic`, or as for reliability.
        liveliness_lease_duration_ns: How soon a silent publisher counts as gone.
        avoid_ros_namespace_conventions: Whether the topic is named outside the ROS conventions.
    """

    history: str = "keep_last"
    depth: int = DEFAULT_DEPTH
    reliability: str = "reliable"
    durability: str = "volatile"
    deadline_ns: int = 0
    lifespan_ns: int = 0
    liveliness: str = "system_default"
    liveliness_lease_duration_ns: int = 0
    avoid_ros_namespace_conventions: bool = False

    def __post_init__(self) -> None:
        for policy, numbers in _POLICY_NUMBERS.items():
            value = getattr(self, policy)
            if value not in numbers:
                raise InvalidInputError(f"qos {policy}", value, f"one of {', '.join(numbers)}")
        if not 0 <= self.depth < 2**31:
            raise InvalidInputError("qos depth", self.depth, "[0, 2^31)")
        for duration in _DURATIONS:
            value = getattr(self, f"{duration}_ns")
            if not 0 <= value <= _INT64_MAX:
                raise InvalidInputError(f"qos {duration}", value, "[0, 2^63) ns")

    @property
    def latched(self) -> bool:
        """Whether late subscribers get the last messages."""
        return self.durability == "transient_local"

    def to_dict(self) -> dict[str, Any]:
        """Returns the mapping that metadata version 9 stores."""
        result: dict[str, Any] = {}
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name.endswith("_ns"):
                sec, nsec = divmod(value, _NANOSECONDS)
                result[field.name.removesuffix("_ns")] = {"sec": sec, "nsec": nsec}
            else:
                result[field.name] = value
        return result

    @staticmethod
    def from_dict(given: Any, base: Qos | None = None, where: str = "qos") -> Qos:
        """Reads the mapping of a bag or of an override file.

        Args:
            given: Policy names to values; policies that are not given come from `base`.
            base: Defaults to the ROS 2 defaults.
            where: Prefix of the field in error messages.

        Raises:
            InvalidInputError: If a policy or a value is unknown.
        """
        if not isinstance(given, Mapping):
            raise InvalidInputError(where, given, "a mapping of policies to values")
        values: dict[str, Any] = {}
        for policy, value in given.items():
            field = f"{where} {policy}"
            if policy in _DURATIONS:
                values[f"{policy}_ns"] = _duration_ns(value, field)
            elif policy in _POLICY_NUMBERS:
                values[policy] = _policy_name(policy, value, field)
            elif policy == "depth":
                values[policy] = _integer(value, field)
            elif policy == "avoid_ros_namespace_conventions":
                if not isinstance(value, bool):
                    raise InvalidInputError(field, value, "true or false")
                values[policy] = value
            else:
                known = (*_POLICY_NUMBERS, "depth", *_DURATIONS, "avoid_ros_namespace_conventions")
                raise InvalidInputError(field, value, f"policy one of {', '.join(known)}")
        return replace(base or Qos(), **values)

    @staticmethod
    def from_rclpy(profile: QoSProfile) -> Qos:
        """Converts from rclpy."""
        values: dict[str, Any] = {
            policy: _policy_name(policy, int(getattr(profile, policy)), f"qos {policy}")
            for policy in _POLICY_NUMBERS
        }
        for duration in _DURATIONS:
            values[f"{duration}_ns"] = getattr(profile, duration).nanoseconds
        return Qos(
            **values,
            depth=profile.depth,
            avoid_ros_namespace_conventions=profile.avoid_ros_namespace_conventions,
        )

    def to_rclpy(self) -> QoSProfile:
        """Converts to rclpy."""
        from rclpy.duration import Duration
        from rclpy.qos import (
            DurabilityPolicy,
            HistoryPolicy,
            LivelinessPolicy,
            QoSProfile,
            ReliabilityPolicy,
        )

        return QoSProfile(
            history=HistoryPolicy(_POLICY_NUMBERS["history"][self.history]),
            depth=self.depth,
            reliability=ReliabilityPolicy(_POLICY_NUMBERS["reliability"][self.reliability]),
            durability=DurabilityPolicy(_POLICY_NUMBERS["durability"][self.durability]),
            deadline=Duration(nanoseconds=self.deadline_ns),
            lifespan=Duration(nanoseconds=self.lifespan_ns),
            liveliness=LivelinessPolicy(_POLICY_NUMBERS["liveliness"][self.liveliness]),
            liveliness_lease_duration=Duration(nanoseconds=self.liveliness_lease_duration_ns),
            avoid_ros_namespace_conventions=self.avoid_ros_namespace_conventions,
        )


def dump_offers(offers: Iterable[Qos]) -> str:
    """Writes `offered_qos_profiles` as an MCAP channel stores it."""
    return yaml.safe_dump([qos.to_dict() for qos in offers], sort_keys=False).strip()


def parse_offers(stored: Any) -> tuple[Qos, ...]:
    """Reads `offered_qos_profiles` in any of its forms: YAML text or a list, names or numbers.

    Raises:
        InvalidInputError: If it is neither, or holds an unknown policy or value.
    """
    where = "offered_qos_profiles"
    if isinstance(stored, str):
        try:
            stored = yaml.safe_load(stored) if stored else []
        except yaml.YAMLError as error:
            raise InvalidInputError(where, stored, f"valid YAML ({error})") from error
    if stored is None:
        return ()
    if not isinstance(stored, Sequence) or isinstance(stored, str):
        raise InvalidInputError(where, stored, "a list of profiles")
    return tuple(Qos.from_dict(item, where=f"{where}[{i}]") for i, item in enumerate(stored))


def publisher_qos(offers: Sequence[Qos]) -> Qos:
    """Chooses what one replaying publisher offers in place of the recorded publishers.

    Where they differ, the strongest offer is made: a subscription that asks for less connects to
    it too. What discovery does not report (history, depth) becomes `keep_last` of
    `DEFAULT_DEPTH`, as in rosbag2, and liveliness automatic, which needs no assertion.
    """
    if not offers:
        return Qos()
    keep_all = any(qos.history == "keep_all" for qos in offers)
    depths = [qos.depth for qos in offers if qos.history == "keep_last" and qos.depth > 0]
    lifespans = [qos.lifespan_ns for qos in offers]
    first = offers[0]
    same_deadline = all(qos.deadline_ns == first.deadline_ns for qos in offers)
    return Qos(
        history="keep_all" if keep_all else "keep_last",
        depth=max(depths, default=DEFAULT_DEPTH),
        reliability=_strongest("reliability", offers, "reliable", "best_effort"),
        durability=_strongest("durability", offers, "transient_local", "volatile"),
        deadline_ns=first.deadline_ns if same_deadline else 0,
        lifespan_ns=0 if 0 in lifespans else max(lifespans),
        liveliness="automatic",
        avoid_ros_namespace_conventions=first.avoid_ros_namespace_conventions,
    )


def subscription_qos(offers: Sequence[Qos], depth: int) -> Qos:
    """Chooses what a recorder asks for so that every publisher's offer satisfies it.

    Args:
        offers: What the publishers offer.
        depth: Messages to queue between two spins.
    """
    reliable = bool(offers) and all(qos.reliability == "reliable" for qos in offers)
    latched = bool(offers) and all(qos.latched for qos in offers)
    return Qos(
        depth=depth,
        reliability="reliable" if reliable else "best_effort",
        durability="transient_local" if latched else "volatile",
    )


def _strongest(policy: str, offers: Sequence[Qos], strong: str, weak: str) -> str:
    """Returns the strong value if any offer has it, and the default if no offer names either."""
    values = {getattr(qos, policy) for qos in offers}
    if strong in values:
        return strong
    return weak if weak in values else str(getattr(Qos(), policy))


def _policy_name(policy: str, value: Any, field: str) -> str:
    numbers = _POLICY_NUMBERS[policy]
    if isinstance(value, int) and not isinstance(value, bool):
        for name, number in numbers.items():
            if number == value:
                return name
    elif isinstance(value, str) and value.lower() in numbers:
        return value.lower()
    raise InvalidInputError(field, value, f"one of {', '.join(numbers)}")


def _integer(value: Any, field: str) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or value < 0:
        raise InvalidInputError(field, value, "an integer of at least 0")
    return value


def _duration_ns(value: Any, field: str) -> int:
    if not isinstance(value, Mapping) or set(value) != {"sec", "nsec"}:
        raise InvalidInputError(field, value, "a mapping with sec and nsec")
    sec, nsec = _integer(value["sec"], f"{field} sec"), _integer(value["nsec"], f"{field} nsec")
    if (sec, nsec) in _FOXY_INFINITE:
        return _INT64_MAX
    return min(sec * _NANOSECONDS + nsec, _INT64_MAX)
