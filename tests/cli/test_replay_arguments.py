"""Arguments of ``gdrl-replay``, and files that are not what they must be."""

from __future__ import annotations

import pytest

from gdrl_torchrl.cli.replay import replay
from gdrl_torchrl.files.state import write_state

WORLD = {"kind": "diverged_world", "task": {"name": "water"}, "before": {}, "action": None}


@pytest.fixture
def file_of(tmp_path):
    def write(content):
        path = tmp_path / "fault.safetensors"
        write_state(path, content)
        return path

    return write


@pytest.mark.parametrize("kind", [["update"], {"a": 1}, 3, None, "other"])
def test_a_kind_that_is_none_is_named(kind, file_of):
    with pytest.raises(ValueError, match=r"kind=.* must be one of") as refused:
        replay(file_of(WORLD | {"kind": kind}), [])
    assert str(refused.value).count("\n") == 0


@pytest.mark.parametrize("name", [["water"], {}, 3, None])
def test_a_task_that_is_none_is_an_error(name, file_of):
    with pytest.raises(ValueError, match=r"fault\.safetensors|task="):
        replay(file_of(WORLD | {"task": {"name": name}}), [])


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("sea=[", "task.sea=[ must be name=value"),
        ("sea={a: b: c}", "must be name=value"),
        ("see=calm", "did you mean task.sea?"),
        ("step_limit=2k", "write 2_000"),
    ],
)
def test_overrides_that_are_none_are_named_on_one_line(override, said, file_of):
    with pytest.raises(ValueError, match=r".") as refused:
        replay(file_of(WORLD), [override])
    assert said in str(refused.value)
    assert str(refused.value).count("\n") == 0
