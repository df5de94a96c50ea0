"""Writing a good bag from what can be saved of a damaged one."""

from __future__ import annotations

from pathlib import Path

from dscp_ros.bag.errors import BagFormatError
from dscp_ros.bag.reader import BagReader
from dscp_ros.bag.recovery import RecoveryReport
from dscp_ros.bag.writer import BagWriter

SOURCE_KEY = "recovered_from"
"""Name of the note in the new bag's custom data."""


def recover_bag(
    path: str | Path, output: str | Path, *, overwrite: bool = False, compression: str = "zstd"
) -> RecoveryReport:
    """Copies every readable message of a bag, in time order, to a new bag.

    Topics, definitions, quality of service, times and payloads are kept as they are; no message
    type has to be installed.

    Args:
        path: The damaged bag.
        output: The bag to write.
        overwrite: Whether to replace `output`.
        compression: `zstd`, `lz4` or `none`.

    Returns:
        What was lost.

    Raises:
        BagNotFoundError: If there is no bag at the path.
        BagFormatError: If no message can be saved although the bag should have some.
        BagExistsError: If the output is taken.
        BagWriteError: If writing fails.
    """
    with BagReader(path) as reader:
        report = reader.verify()
        if not report.messages_read and not report.intact:
            raise BagFormatError(f"{path}: no message can be saved: {report.damages[0]}")
        notes = dict(reader.metadata.custom_data) if reader.metadata is not None else {}
        notes[SOURCE_KEY] = f"{reader.path.name}: {'; '.join(report.lines())}"
        with BagWriter(
            output, overwrite=overwrite, compression=compression, custom_data=notes
        ) as writer:
            for topic in reader.topics.values():
                writer.add_topic(
                    topic.name, topic.type_name, topic.offers, definition=topic.definition
                )
            for message in reader.messages():
                writer.write_raw(
                    message.topic.name,
                    message.data,
                    message.log_time_ns,
                    message.publish_time_ns,
                    message.sequence,
                )
        return report
