"""Matrices whose factors grow without pivots: propagated entries."""

from __future__ import annotations

import numpy as np
import pytest

from dscp_core import Discretisation, problems
from dscp_core.scp.scp import Scp, ScpOptions
from dscp_core.transcription.transcription import Transcription


@pytest.mark.parametrize("intervals", [50, 100, 200])
def test_a_propagated_entry_is_linearised_exactly(intervals: int) -> None:
    transcription = Transcription(
        problems.get("entry"), intervals, discretisation=Discretisation.PROPAGATED
    )
    options = ScpOptions.for_gradients(fixed_iterations=6)
    run = Scp(transcription, options).run(transcription.problem.pack())
    random = np.random.default_rng(5)
    for iteration in run.iterations:
        found = iteration.linearisation
        assert found is not None
        found.adjoint(random.standard_normal(found.z.size))
        assert found.verdict.polished
        assert found.verdict.trusted, found.verdict.reasons
