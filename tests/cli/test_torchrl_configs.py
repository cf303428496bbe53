"""Our hook by name in TorchRL's own Hydra configurations."""

from __future__ import annotations

import dataclasses
import inspect
import re
import warnings
from pathlib import Path

import pytest
import torch
from hydra import compose, initialize_config_dir
from hydra.core.config_store import ConfigStore
from hydra.utils import instantiate
from omegaconf import OmegaConf
from omegaconf.errors import MissingMandatoryValue
from torchrl.envs import EnvBase

from gdrl_torchrl.cli.torchrl_configs import GeneticHookConfig, register_torchrl_configs
from gdrl_torchrl.evolution.hooks.attach import NOT_ATTACHED, AttachedGeneticHook
from gdrl_torchrl.evolution.settings import EvolutionConfig

PAGE = Path(__file__).resolve().parents[2] / "docs" / "extending" / "torchrl_hydra.md"
SMALL = (
    "frames=600",
    "value_network.num_cells=[8]",
    "trainer.optim_steps_per_batch=2",
    "genetic.period_episodes=5",
    "genetic.num_trials=1",
    "genetic.max_steps=50",
    "genetic.mut_v=1.0",
)


def blocks(language):
    return re.findall(rf"```{language}\n(.*?)```", PAGE.read_text(), flags=re.DOTALL)


@pytest.fixture
def folder(tmp_path):
    """A folder ``conf`` with the page's yaml file."""
    (text,) = blocks("yaml")
    (tmp_path / "conf").mkdir()
    (tmp_path / "conf" / "dqn.yaml").write_text(text)
    return tmp_path


@pytest.fixture
def composed(folder):
    def make(*overrides):
        register_torchrl_configs()
        with initialize_config_dir(str(folder / "conf"), version_base="1.3"):
            return compose("dqn", overrides=[*SMALL, *overrides])

    return make


@pytest.fixture(autouse=True)
def _quiet():
    # TorchRL warns that its trainers are prototypes.
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


def same(values, genome):
    """Whether weights by dotted name are exactly a genome's."""
    values, wanted = dict(values.items()), dict(genome.flatten_keys(".").items())
    assert set(wanted) <= set(values)
    return all(torch.equal(values[name], value) for name, value in wanted.items())


def test_a_stock_trainer_of_yaml_alone_evolves_its_agent(composed):
    config = composed()
    hook = instantiate(config.genetic)
    trainer = instantiate(config.trainer, hooks=[hook])
    loss, genetic = trainer.loss_module, hook.genetic
    populations, ended, found = [], [], []
    evaluate = genetic.evaluator.evaluate

    def watched(params, **options):
        populations.append(params.clone())
        return evaluate(params, **options)

    def look(evaluation):
        found.append(evaluation)
        scores, winner = evaluation.scores["fitness"], evaluation.winner
        assert scores[winner] == scores.max()
        assert evaluation.switched == (winner != 0)
        genome = populations[-1][winner]
        assert same(loss.value_network.state_dict(), genome)
        assert same(trainer.collector.policy[0].state_dict(), genome)
        if evaluation.switched:
            assert same(loss.target_value_network_params.flatten_keys("."), genome)
            assert not same(loss.value_network.state_dict(), populations[-1][0])

    genetic.evaluator.evaluate = watched
    genetic.on_evaluation.append(look)
    trainer.register_op("batch_process", lambda td: ended.append(td["next", "done"]) or td)
    assert genetic.evaluator.env is not trainer.collector.env
    trainer.train()
    episodes = int(torch.cat(ended).sum())
    assert 2 <= len(found) <= episodes // 5
    assert any(evaluation.switched for evaluation in found)
    assert all(population.batch_size == torch.Size([5]) for population in populations)
    optimised = {
        id(parameter)
        for group in trainer.optimizer.param_groups
        for parameter in group["params"]
    }
    assert optimised == {id(parameter) for parameter in loss.value_network.parameters()}


def test_a_trainer_takes_the_hook_by_name(composed):
    # Made by the trainer's own configuration, so only its checkpoints tell of it.
    trainer = instantiate(composed("frames=300").trainer)
    states = []
    trainer.register_op("post_steps", lambda: states.append(trainer.state_dict()))
    trainer.train()
    assert states[-1]["genetic_hook"]["counts"]["evaluations"] >= 1


@pytest.mark.parametrize("partial", ["true", "false"])
def test_the_environment_may_be_a_partial_or_made_at_once(partial, composed):
    config = composed(f"evaluation_env._partial_={partial}")
    hook = instantiate(config.genetic)
    trainer = instantiate(config.trainer, hooks=[hook])
    env = hook.genetic.evaluator.env
    assert isinstance(env, EnvBase)
    assert env is hook.genetic.evaluator.env, "it is made once"
    assert hook.genetic.evaluate().population_steps >= 5
    trainer.collector.shutdown()


def test_an_environment_must_be_named(composed):
    with pytest.raises(MissingMandatoryValue, match="create_env_fn"):
        instantiate(composed("genetic.create_env_fn=???").genetic)


def test_a_wrong_type_is_refused_when_composed(composed):
    with pytest.raises(Exception, match="many"):
        composed("genetic.num_children=many")


def test_every_option_of_the_hook_is_a_field_with_its_default():
    own = inspect.signature(AttachedGeneticHook).parameters
    defaults = {name: option.default for name, option in own.items() if name != "settings"}
    settings = dataclasses.asdict(EvolutionConfig())
    for name in NOT_ATTACHED:
        del settings[name]
    config = OmegaConf.to_container(OmegaConf.structured(GeneticHookConfig))
    target = config.pop("_target_")
    assert target == f"{AttachedGeneticHook.__module__}.{AttachedGeneticHook.__name__}"
    assert config.pop("create_env_fn") == "???"
    del defaults["create_env_fn"]
    defaults["on_evaluation"] = list(defaults["on_evaluation"])
    assert config == settings | defaults
    AttachedGeneticHook(create_env_fn=lambda: None, **config)


def test_functions_may_hear_of_evaluations(composed, capsys):
    told = "genetic.on_evaluation=[{_target_: builtins.print, _partial_: true}]"
    config = composed(told)
    hook = instantiate(config.genetic)
    trainer = instantiate(config.trainer, hooks=[hook])
    hook.genetic.evaluate()
    assert "GeneticEvaluation(number=0" in capsys.readouterr().out
    trainer.collector.shutdown()


def test_it_is_stored_under_our_own_provider_beside_torchrls():
    register_torchrl_configs()
    register_torchrl_configs()
    store = ConfigStore.instance()
    assert store.load("hook/genetic.yaml").provider == "gdrl_torchrl"
    assert store.load("hook/log_timing.yaml").provider != "gdrl_torchrl"
    names = store.list("hook")
    assert names.count("genetic.yaml") == 1
    assert dataclasses.is_dataclass(GeneticHookConfig)


def test_the_python_of_the_page_runs(folder, monkeypatch, capsys):
    file = folder / "conf" / "dqn.yaml"
    text = file.read_text()
    assert "frames: 10000\n" in text
    file.write_text(text.replace("frames: 10000\n", "frames: 150\n"))
    monkeypatch.chdir(folder)
    namespace = {}
    for block in blocks("python"):
        exec(block, namespace)
    assert re.search(r"\d+ evaluations, \d+ switches", capsys.readouterr().out)
