"""An invented study, for all tests of reports."""

from __future__ import annotations

import pytest

from tests.reports.invented import write_study


@pytest.fixture(scope="session")
def study(tmp_path_factory):
    """Two tasks with two methods each and eight seeds; one run failed, one is missing."""
    results = tmp_path_factory.mktemp("results")
    return write_study(results, failed=[("ppo", 3)], leave_out=[("grainbow", 7)])
