"""What each algorithm can be told."""

from __future__ import annotations

from gdrl_torchrl.agents.ga.settings import GAConfig
from gdrl_torchrl.agents.ppo.settings import PPOConfig
from gdrl_torchrl.agents.rainbow.settings import RainbowConfig
from gdrl_torchrl.agents.settings import with_algorithms
from gdrl_torchrl.plugins import Offers

ALGORITHMS: dict[str, type] = {
    "ppo": PPOConfig,
    "rainbow": RainbowConfig,
    "ga": GAConfig,
}
"""The dataclass of each ``conf/algorithm`` of ours."""


def algorithm_configs() -> Offers:
    """The dataclass of each algorithm, those of other packages included."""
    offers = with_algorithms(ALGORITHMS)
    others = {n: offer.config for n, offer in offers.items() if n not in ALGORITHMS}
    return Offers(others | ALGORITHMS, offers.broken)
