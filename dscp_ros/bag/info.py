"""What is in a bag, for people and for scripts."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any

from dscp_ros.bag.reader import BagReader
from dscp_ros.bag.topics import TopicInfo

_NANOSECONDS = 1e9


def bag_info(reader: BagReader) -> dict[str, Any]:
    """Describes an open bag in plain values for JSON. Times in nanoseconds since the epoch."""
    metadata = reader.metadata
    duration_s = reader.duration_ns / _NANOSECONDS
    return {
        "path": str(reader.path),
        "files": [str(path) for path in reader.files],
        "size_bytes": reader.size_bytes,
        "ros_distro": None if metadata is None else metadata.ros_distro,
        "start_ns": reader.start_ns,
        "end_ns": reader.end_ns,
        "duration_s": duration_s,
        "message_count": reader.message_count,
        "topics": [_topic_info(topic, duration_s) for topic in reader.topics.values()],
        "custom_data": {} if metadata is None else dict(metadata.custom_data),
        "report": reader.report.to_dict(),
    }


def _topic_info(topic: TopicInfo, duration_s: float) -> dict[str, Any]:
    intervals = topic.message_count - 1
    rate_hz = intervals / duration_s if duration_s > 0 and intervals > 0 else None
    return {
        "name": topic.name,
        "type": topic.type_name,
        "message_count": topic.message_count,
        "mean_rate_hz": rate_hz,
        "type_hash": topic.type_hash,
        "offered_qos_profiles": [qos.to_dict() for qos in topic.offers],
    }


def info_lines(reader: BagReader) -> list[str]:
    """Describes an open bag as text."""
    info = bag_info(reader)
    distribution = "" if not info["ros_distro"] else f"  ROS distribution {info['ros_distro']}"
    lines = [
        f"Bag:       {info['path']}",
        f"Files:     {', '.join(path.name for path in reader.files)}",
        f"Size:      {info['size_bytes'] / 1024:.1f} KiB{distribution}",
        f"Start:     {_date(info['start_ns'])}",
        f"End:       {_date(info['end_ns'])}",
        f"Duration:  {info['duration_s']:.3f} s",
        f"Messages:  {info['message_count']}",
        "Topics:",
    ]
    width = max((len(name) for name in reader.topics), default=0)
    type_width = max((len(topic.type_name) for topic in reader.topics.values()), default=0)
    for topic in reader.topics.values():
        latched = ", latched" if any(qos.latched for qos in topic.offers) else ""
        count = f"{topic.message_count} messages{latched}"
        lines.append(f"  {topic.name:<{width}}  {topic.type_name:<{type_width}}  {count}")
    lines.extend(f"Note:      {key}: {value}" for key, value in info["custom_data"].items())
    lines.extend(f"Damage:    {damage}" for damage in reader.report.damages)
    return lines


def _date(time_ns: int) -> str:
    if time_ns == 0:
        return "none"
    date = datetime.fromtimestamp(time_ns // 10**9, UTC)
    return f"{date:%Y-%m-%d %H:%M:%S}.{time_ns % 10**9:09d} UTC"
