"""The mutation schedule, and the window of successes in the order of their start."""

from __future__ import annotations

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gdrl_torchrl.evolution.hooks.watch import SuccessWindow
from gdrl_torchrl.evolution.operators.schedule import MutationSchedule


@pytest.mark.parametrize(
    ("success", "mut_p"),
    [(None, 0.75), (0.0, 0.75), (0.399, 0.75), (0.4, 0.4), (0.799, 0.4), (0.8, 0.1)],
)
def test_mutation_weakens_as_success_grows(success, mut_p):
    assert MutationSchedule()(success) == mut_p


@given(
    thresholds=st.lists(st.floats(0.0, 1.0), min_size=0, max_size=4, unique=True).map(
        sorted
    ),
    success=st.floats(0.0, 1.0),
)
def test_a_rate_holds_from_its_threshold_on(thresholds, success):
    rates = tuple(i / 10 for i in range(len(thresholds) + 1))
    passed = [limit for limit in thresholds if limit <= success]
    schedule = MutationSchedule(rates, tuple(thresholds))
    assert schedule(success) == rates[len(passed)]
    assert schedule(None) == rates[0]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"rates": (0.5,)}, r"rates=\(0.5,\)"),
        ({"rates": (0.5, 0.2, 1.2)}, "1.2"),
        ({"rates": (0.5, -0.2, 0.1)}, "-0.2"),
        ({"rates": (0.5, float("nan"), 0.1)}, "nan"),
        ({"thresholds": (0.8, 0.4)}, r"thresholds=\(0.8, 0.4\)"),
        ({"thresholds": (0.4, 0.4)}, r"thresholds=\(0.4, 0.4\)"),
    ],
)
def test_bad_schedules_are_named_with_their_value(options, message):
    with pytest.raises(ValueError, match=message):
        MutationSchedule(**options)


class Oracle:
    """Keeps every episode for ever and looks at all of them on each question."""

    def __init__(self, size):
        self.size, self.began, self.ended = size, [], {}

    @property
    def counted(self):
        count = 0
        while count < len(self.began) and self.began[count] in self.ended:
            count += 1
        return [self.ended[episode] for episode in self.began[:count]][-self.size :]


@st.composite
def histories(draw):
    """Episodes begin in order; any running one may end, with or without success."""
    events, running, begun = [], [], 0
    for _ in range(draw(st.integers(0, 40))):
        if not running or draw(st.booleans()):
            count = draw(st.integers(1, 3))
            new = list(range(begun, begun + count))
            events.append(("begin", new))
            running += new
            begun += count
        else:
            episode = running.pop(draw(st.integers(0, len(running) - 1)))
            events.append(("finish", episode, draw(st.booleans())))
    return events


@given(size=st.integers(1, 6), events=histories(), cut=st.integers(0, 40))
def test_the_window_is_over_the_last_episodes_in_the_order_of_their_start(
    size, events, cut
):
    window, oracle = SuccessWindow(size), Oracle(size)
    for place, event in enumerate(events):
        if place == cut:
            # A round trip through plain JSON changes nothing.
            state = json.loads(json.dumps(window.state_dict()))
            window = SuccessWindow(size)
            window.load_state_dict(state)
        if event[0] == "begin":
            window.begin(event[1])
            oracle.began += event[1]
        else:
            window.finish(*event[1:])
            oracle.ended[event[1]] = event[2]
        counted = oracle.counted
        assert len(window) == len(counted)
        share = sum(counted) / len(counted) if counted else None
        assert window.running_rate == share
        assert window.rate == (share if len(counted) == size else None)


def test_an_unfinished_episode_holds_back_those_that_began_after_it():
    window = SuccessWindow(size=2)
    window.begin([0, 1, 2])
    window.finish(2, True)
    window.finish(1, True)
    assert len(window) == 0
    window.finish(0, False)
    assert len(window) == 2
    assert window.rate == 1.0, "the last two in the order of their start"


def test_running_episodes_can_be_forgotten_and_hold_back_no_other():
    window = SuccessWindow(size=3)
    window.begin([0, 1, 2, 3])
    window.finish(1, True)
    window.finish(3, False)
    assert [number for number in range(5) if window.is_open(number)] == [0, 2]
    window.forget_running()
    assert len(window) == 2
    assert window.running_rate == 0.5
    assert not any(window.is_open(number) for number in range(4))
    window.begin([0])
    window.finish(0, True)
    assert window.rate == pytest.approx(2 / 3)


def test_episodes_that_never_began_are_refused():
    with pytest.raises(ValueError, match="episode=3"):
        SuccessWindow().finish(3, True)


def test_a_window_needs_a_size():
    with pytest.raises(ValueError, match="size=0"):
        SuccessWindow(0)
