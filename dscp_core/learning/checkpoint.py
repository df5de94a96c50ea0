"""Checkpoints of a training run: arrays and a JSON document in one safetensors file."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from dscp_core.errors import DscpError
from dscp_core.files import replace_file

CHECKPOINT_FILE = "checkpoint.safetensors"
_FORMAT = "dscp_training_checkpoint"
_VERSION = 1


class CheckpointError(DscpError):
    """A checkpoint that is damaged, or belongs to another training."""


@dataclass
class Checkpoint:
    """What is needed to go on as if nothing had happened.

    Attributes:
        arrays: By name.
        document: Anything that JSON holds.
    """

    arrays: dict[str, NDArray[Any]] = field(default_factory=dict)
    document: dict[str, Any] = field(default_factory=dict)

    def save(self, path: Path) -> None:
        """Write atomically.

        Raises:
            FileWriteError: The file cannot be written; the last checkpoint is still there.
        """
        metadata = {
            "format": _FORMAT,
            "version": str(_VERSION),
            "document": json.dumps(self.document, sort_keys=True),
        }
        arrays = {name: np.ascontiguousarray(array) for name, array in self.arrays.items()}
        replace_file(path, save(arrays, metadata))

    @staticmethod
    def load(path: Path) -> Checkpoint:
        """Read a checkpoint.

        Raises:
            FileNotFoundError: There is none.
            CheckpointError: It is damaged, or the file is no checkpoint.
        """
        if not path.is_file():
            raise FileNotFoundError(2, "No such file", str(path))
        try:
            with safe_open(path, framework="numpy") as file:
                metadata = dict(file.metadata() or {})
                names = file.keys()
                arrays = {name: np.array(file.get_tensor(name)) for name in names}
        except SafetensorError as error:
            raise CheckpointError(f"{path}: no readable safetensors file ({error})") from None
        if (metadata.get("format"), metadata.get("version")) != (_FORMAT, str(_VERSION)):
            raise CheckpointError(f"{path}: no training checkpoint of version {_VERSION}")
        try:
            document = json.loads(metadata["document"])
        except (KeyError, json.JSONDecodeError) as error:
            raise CheckpointError(f"{path}: {error}") from None
        return Checkpoint(arrays, document)
