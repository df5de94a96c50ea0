"""Which files make up a bag."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from dscp_ros.bag.errors import BagError, BagFormatError, BagNotFoundError
from dscp_ros.bag.mcap_file import McapFile
from dscp_ros.bag.metadata import METADATA_FILE, BagMetadata, parse_record, read_metadata
from dscp_ros.bag.recovery import Damage, DamageKind


@dataclass
class BagFiles:
    """The open files of a bag.

    Attributes:
        files: In the order of the bag.
        metadata: The bag's metadata, or None where there is none that can be read.
        damages: What was found damaged on opening.
    """

    files: list[McapFile]
    metadata: BagMetadata | None
    damages: list[Damage]

    def close(self) -> None:
        """Closes all files."""
        for file in self.files:
            file.close()


def open_bag(path: Path) -> BagFiles:
    """Opens a bag directory, with or without metadata.yaml, or a single file.

    Raises:
        BagNotFoundError: If the path does not exist, or is a directory without MCAP files.
        BagFormatError: If nothing in it can be read.
    """
    if path.is_dir():
        return _open_directory(path)
    file = McapFile(path)
    damages = list(file.damages)
    return BagFiles([file], _metadata_in(file, damages), damages)


def _open_directory(directory: Path) -> BagFiles:
    metadata, damages = _directory_metadata(directory)
    found = sorted(directory.glob("*.mcap"), key=_natural_order)
    if metadata is None:
        paths = found
    else:
        paths = [directory / Path(name).name for name in metadata.relative_file_paths]
    if not paths:
        raise BagNotFoundError(f"{directory}: no {METADATA_FILE} and no .mcap file in it")
    files: list[McapFile] = []
    errors: list[BagError] = []
    for path in paths:
        try:
            file = McapFile(path)
        except (BagNotFoundError, BagFormatError) as error:
            errors.append(error)
            damages.append(_missing_file(path, error, metadata))
        else:
            files.append(file)
            damages.extend(file.damages)
    if not files:
        raise errors[0]
    if metadata is None and len(files) == 1:
        metadata = _metadata_in(files[0], damages)
    return BagFiles(files, metadata, damages)


def _directory_metadata(directory: Path) -> tuple[BagMetadata | None, list[Damage]]:
    path = directory / METADATA_FILE
    if not path.exists():
        return None, []
    try:
        metadata = read_metadata(path)
    except BagFormatError as error:
        return None, [Damage(DamageKind.CORRUPT_METADATA, path, str(error))]
    if metadata.storage_identifier != "mcap":
        raise BagFormatError(
            f"{path}: storage {metadata.storage_identifier!r} is not supported, only 'mcap'"
        )
    if metadata.compression_mode:
        raise BagFormatError(
            f"{path}: compression mode {metadata.compression_mode!r} is not supported; "
            "MCAP files compress their chunks themselves"
        )
    return metadata, []


def _metadata_in(file: McapFile, damages: list[Damage]) -> BagMetadata | None:
    if file.index.metadata is None:
        return None
    try:
        return parse_record(file.index.metadata, str(file.path))
    except BagFormatError as error:
        damages.append(Damage(DamageKind.CORRUPT_METADATA, file.path, str(error)))
        return None


def _missing_file(path: Path, error: BagError, metadata: BagMetadata | None) -> Damage:
    for file in metadata.files if metadata is not None else ():
        if Path(file.path).name == path.name:
            return Damage(
                DamageKind.MISSING_FILE,
                path,
                str(error),
                messages_lost=file.message_count,
                start_time_ns=file.start_ns,
                end_time_ns=file.start_ns + file.duration_ns,
            )
    return Damage(DamageKind.MISSING_FILE, path, str(error), messages_lost=None)


def _natural_order(path: Path) -> list[tuple[int, str]]:
    """Sorts `bag_10.mcap` after `bag_9.mcap`."""
    parts = re.split(r"(\d+)", path.name)
    return [(int(part), "") if part.isdigit() else (-1, part) for part in parts]
