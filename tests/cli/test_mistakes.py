"""The mistakes that users make most: one line, with what to do, before torch is imported.

``docs/errors.md`` lists them with the same texts.
"""

from __future__ import annotations

import json
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from gdrl_tasks import task_names, task_options
from gdrl_torchrl.agents.registry import ALGORITHMS
from gdrl_torchrl.cli.shared.compose import load_experiment
from gdrl_torchrl.config.options import section_classes
from gdrl_torchrl.config.search import SearchConfig
from gdrl_torchrl.config.sentences import options_of
from gdrl_torchrl.evolution.operators import crossover, mutation, selection
from gdrl_torchrl.evolution.settings import CROSSOVERS, EVOLUTIONS, MUTATIONS, TIE_RULES
from tests.marks import full_but

ROOT = Path(__file__).parents[2]
RUN = """
import atexit, importlib, json, os, sys
command, folder, lines = sys.argv[1], sys.argv[2], json.loads(sys.argv[3])
main = importlib.import_module(f"gdrl_torchrl.cli.{command}").main
for number, arguments in enumerate(lines):
    child = os.fork()
    if child == 0:
        for stream, name in ((1, "printed"), (2, "said")):
            file = os.open(f"{folder}/{number}.{name}", os.O_WRONLY | os.O_CREAT)
            os.dup2(file, stream)
        atexit.register(lambda: print("torch" if "torch" in sys.modules else "quick"))
        sys.argv = [f"gdrl-{command}", *arguments]
        main()
        sys.exit()
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""
"""A command with one line of arguments after the other, each in a fork that has imported
nothing but the command; it prints at its end whether torch, which takes seconds, was
imported."""
COMMANDS = ("train", "evaluate", "runs", "search", "replay")
LINES = [
    ("train", 8),
    *((command, 1) for command in COMMANDS[1:]),
    pytest.param("train", 1, marks=pytest.mark.full),
]
"""Commands, and the distance between the lines that are tried: each of training composes
a whole configuration."""
MISTAKES = {
    "gdrl-train experiment=gpo_water": (
        "experiment=gpo_water must be one that exists: did you mean experiment=gppo_water?"
    ),
    "gdrl-train gppo_water": (
        "'gppo_water' must be name=value, such as experiment=gppo_water"
    ),
    "gdrl-train --seed=1": "--seed=1 must be written seed=1",
    "gdrl-train learning_rate=0.01": (
        "learning_rate=0.01 must be an option that exists: did you mean "
        "algorithm.learning_rate?"
    ),
    "gdrl-train algorithm.gama=0.5": (
        "algorithm.gama=0.5 must be an option that exists: did you mean algorithm.gamma?"
    ),
    "gdrl-train +algorithm.gama=0.5": (
        "+algorithm.gama=0.5 must be an option that exists: did you mean algorithm.gamma?"
    ),
    "gdrl-train task.sea=stormy": (
        "task.sea='stormy' must be one of ['calm', 'lake', 'rough'] or None"
    ),
    "gdrl-train evolution.num_children=0": (
        "evolution.num_children=0 must be a whole number >= 1 and <= 100000"
    ),
    "gdrl-train budget.agent_steps=150k": (
        "budget.agent_steps=150k must be a whole number >= 1 and <= 1000000000000 or None: "
        "write 150_000"
    ),
    "gdrl-train evaluation.episodes=abc": (
        "evaluation.episodes=abc must be a whole number >= 1 and <= 1000000"
    ),
    "gdrl-train seed=0,1": (
        "seed=0,1 must be one value: -m runs each of several, and a list is written "
        "name=[a,b]"
    ),
    "gdrl-train +sweep=trials": (
        "+sweep=trials must come after -m: gdrl-train -m +sweep=trials"
    ),
    "gdrl-train experiment=grainbow_water task.actions=continuous": (
        "task.actions='continuous' must be 'discrete' with algorithm.name='rainbow': give "
        "task.actions=discrete"
    ),
    "gdrl-evaluate run=elsewhere": (
        "run=elsewhere must be a run directory: it has no config.json"
    ),
    "gdrl-runs elsewhere": "elsewhere must be a folder with runs below it",
}
OTHERS = {
    "gdrl-train budget.agent_steps=1e5": "write 100_000",
    "gdrl-train 'network.actor_cells=[32,'": "must be name=value",
    "gdrl-train +task.see=rough": "did you mean task.sea?",
    "gdrl-train +evolution.num_childs=3": "did you mean evolution.num_children?",
    "gdrl-train +network.actor_cell=[3]": "did you mean network.actor_cells?",
    "gdrl-train +budget.total=3": "did you mean budget.total_steps?",
    "gdrl-train +sede=3": "did you mean seed?",
    "gdrl-train +hydra.job.chdirs=true": "did you mean hydra.job.chdir?",
    "gdrl-train sweep=trials": "must be written +sweep=trials, after -m",
    "gdrl-train +experiment=gppo_water": "must be given once, without +",
    "gdrl-train task=null": "task=null must be one of indoor, indoor_corridor, ",
    "gdrl-train evaluation=3": "must be given by its options, such as evaluation.<option>",
    "gdrl-train algorithm=dqn": "algorithm=dqn must be one of ga, ppo, ppo_sparse, rainbow",
    "gdrl-train --fast": "must be a switch that exists: see gdrl-train --help",
    "gdrl-train experiment=ppo_water +regime=unstable": (
        "regime=unstable must go with what else is chosen: it sets algorithm.target_tau"
    ),
    "gdrl-train --help task=mars": "must be task=indoor|water",
    "gdrl-train -m name=../../x seed=0,1": "name='../../x' must be a folder's name",
    "gdrl-train -m name=a,../../x": "name='../../x' must be a folder's name",
    "gdrl-train -m +algorithm.gama=0.5 seed=0,1": "did you mean algorithm.gamma?",
    "gdrl-evaluate": "run=<run directory> must be given",
    "gdrl-evaluate --episodes 3": "see gdrl-evaluate --help",
    "gdrl-replay": "one file must be given",
    "gdrl-replay elsewhere": "elsewhere must be a file",
    "gdrl-search": "+search=<name> must be given once",
    "gdrl-search +search=gpo_water": "did you mean +search=gppo_water?",
    "gdrl-search +search=gppo_water task.see=calm": "did you mean task.sea?",
    "gdrl-search +search=gppo_water search.num_trials=1e1": "write 10",
    "gdrl-search +search=gppo_water search.name=../../x": "must be a folder's name",
    "gdrl-runs --all": "see gdrl-runs --help",
}


def answers(command, lines, folder, tmp_path_factory):
    """The exit code of each line of a command, and what it printed and said."""
    streams = tmp_path_factory.mktemp("streams")
    arguments = [shlex.split(line)[1:] for line in lines]
    done = subprocess.run(
        [sys.executable, "-c", RUN, command, str(streams), json.dumps(arguments)],
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=300,
        check=True,
    )
    for number, (line, code) in enumerate(zip(lines, done.stdout.split(), strict=True)):
        printed, said = (
            (streams / f"{number}.{name}").read_text() for name in ("printed", "said")
        )
        yield line, int(code), printed.splitlines(), said


@pytest.mark.slow
@pytest.mark.parametrize(("command", "every"), LINES)
def test_a_mistake_is_one_line_that_says_what_to_do(
    command, every, tmp_path, tmp_path_factory
):
    below = tmp_path / "here" / "below"
    below.mkdir(parents=True)
    texts = MISTAKES | OTHERS
    lines = [line for line in texts if shlex.split(line)[0] == f"gdrl-{command}"]
    lines = lines[::every]
    for line, code, printed, said in answers(command, lines, below, tmp_path_factory):
        assert code == 1, line
        assert said.startswith("error: "), line
        assert said.count("\n") == 1, said
        exact = said == f"error: {texts[line]}\n"
        assert exact if line in MISTAKES else (texts[line] in said), said
        assert printed == ["quick"], line
    assert [*tmp_path.rglob("*")] == [below.parent, below], "nothing may be written"


def test_the_mistakes_are_documented_with_what_is_said():
    text = (ROOT / "docs" / "errors.md").read_text()
    for line, said in MISTAKES.items():
        assert f"| `{line}` | `{said.replace('|', chr(92) + '|')}` |" in text


@pytest.mark.slow
@pytest.mark.parametrize("command", full_but(["train"], COMMANDS))
def test_help_has_a_meaning_for_everything_and_two_examples(
    command, tmp_path, tmp_path_factory
):
    line = f"gdrl-{command} --help"
    [(_, code, printed, said)] = answers(command, [line], tmp_path, tmp_path_factory)
    assert (code, said) == (0, "")
    assert printed[-1] == "quick"
    assert printed[0].startswith(f"usage: gdrl-{command} ")
    examples = printed[printed.index("examples:") + 1 : -1]
    assert len([line for line in examples if line.startswith(f"  gdrl-{command} ")]) == 2
    rows = [line for line in printed if line.startswith("  ") and line[2] != " "]
    assert not [row for row in rows if row.endswith(" -")], "without a meaning"


def test_the_help_of_training_lists_groups_and_options(tmp_path, tmp_path_factory):
    lines = ["gdrl-train --help", "gdrl-train --help algorithm=rainbow task=indoor_trap"]
    told = answers("train", lines, tmp_path, tmp_path_factory)
    plain, chosen = (
        {line.split()[0] for line in printed if line.startswith("  ")}
        for _, _, printed, _ in told
    )
    assert plain >= {"gppo_water", "grainbow_indoor", "water", "ppo", "erl", "trials"}
    assert plain >= {"water_near", "indoor_trap", "little_data", "unstable"}
    assert plain >= {"seed=0", "budget.agent_steps=null", "evaluation.episodes=500"}
    assert chosen >= {"algorithm.num_atoms=51", "task.num_beams=19"}


def test_every_option_has_a_sentence():
    owners = [
        *((s, owner) for s, owner in section_classes() if s != "task"),
        *(("task", task_options(name)) for name in task_names()),
        ("search", SearchConfig),
    ]
    assert {owner for _, owner in owners} >= {*ALGORITHMS.values(), *EVOLUTIONS.values()}
    rows = [row for section, owner in owners for row in options_of(owner, section)]
    assert len(rows) > 120
    for name, meaning in rows:
        assert meaning.endswith("."), name


def test_names_that_are_known_without_torch_are_those_of_the_functions():
    assert set(CROSSOVERS) == set(crossover.CROSSOVERS)
    assert set(MUTATIONS) == set(mutation.MUTATIONS)
    assert TIE_RULES == selection.TIE_RULES


@pytest.mark.parametrize(
    "override",
    ["+algorithm.gama=0.5", "+task.see=rough", "+x.y=1", "+evaluation.world=3"],
)
def test_options_that_do_not_exist_are_refused_in_every_composition(override):
    with pytest.raises(ValueError, match=r"\+\S.* must be an option that exists"):
        load_experiment([override])
