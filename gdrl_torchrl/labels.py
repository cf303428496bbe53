"""What agents are called."""

from __future__ import annotations


def algorithm_label(algorithm: str, evolution: str | None) -> str:
    """What an agent with a population is called in tables and figures.

    Args:
        algorithm: Name of the agent's algorithm.
        evolution: Name of the evolution beside it; None if there is none.

    Examples:
        >>> [algorithm_label("ppo", e) for e in (None, "genetic", "erl")]
        ['ppo', 'gppo', 'erl_ppo']
    """
    if evolution is None:
        return algorithm
    return f"g{algorithm}" if evolution == "genetic" else f"{evolution}_{algorithm}"
