"""Tasks whose episodes are filmed."""

from __future__ import annotations

import pytest

from gdrl_tasks import NavigationTask, make_task

TASKS = ("water", "indoor")


@pytest.fixture(params=TASKS)
def task(request: pytest.FixtureRequest) -> NavigationTask:
    return make_task(request.param)


@pytest.fixture(params=TASKS)
def short_task(request: pytest.FixtureRequest) -> NavigationTask:
    """Episodes of three control steps."""
    return make_task(request.param, step_limit=3)
