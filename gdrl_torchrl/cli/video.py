"""``gdrl-video run=<dir> episodes=N task.sea=rough ...``: a film of a run's policy."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from gdrl_torchrl.cli.shared.show_arguments import Arguments, number_in

_FPS = 25
_ARGUMENTS = Arguments(
    "gdrl-video",
    "Film a trained policy on worlds that training never saw; print the file.",
    {
        "episodes=<number>": "Episodes, one after another; 2 if it is not given.",
        "seconds=<number>": "At most so long, faster than life if need be; 6 if not given.",
        "file=<name>.mp4": "What to write; <run>/videos/episodes.mp4 if it is not given.",
    },
    [
        "  gdrl-video run=runs/gppo_water/water/gppo/c5a88fc9/seed_0",
        "  gdrl-video run=<folder> episodes=4 seconds=20 task.sea=rough file=rough.mp4",
    ],
)


def film_run(values: dict[str, str], overrides: Sequence[str]) -> Path:
    """Film the policy of a run.

    Args:
        values: ``run`` and the other options by name, as texts.
        overrides: Other options of the task, ``option=value``.

    Returns:
        The file written.

    Raises:
        ValueError: If an option is not valid, or a file of the run is missing or damaged.
        OSError: If the film cannot be written.
    """
    episodes = number_in(values, "episodes", 2, least=1, most=1000)
    seconds = number_in(values, "seconds", 6.0, least=0.1, most=3600.0)
    file = Path(values.get("file", Path(values["run"], "videos", "episodes.mp4")))
    if file.suffix != ".mp4":
        raise ValueError(f"file={file} must end in .mp4")
    # These take seconds to import: arguments are checked before.
    from tqdm import tqdm

    from gdrl_torchrl.cli.shared.saved_policy import SavedPolicy

    policy = SavedPolicy.of(values["run"], overrides)
    from gdrl_torchrl.pictures.film.video import write_video

    act = policy.load()
    with tqdm(unit="frame", file=sys.stderr, dynamic_ncols=True, leave=False) as bar:

        def show(written: int, all_of_them: int) -> None:
            bar.total = all_of_them
            bar.update(written - bar.n)

        options: dict[str, Any] = {"fps": _FPS, "max_frames": round(_FPS * seconds)}
        write_video(
            policy.task, act, policy.seeds(episodes), file, progress=show, **options
        )
    return file


def main() -> None:
    """Entry point of ``gdrl-video``."""
    values, overrides = _ARGUMENTS.read()
    try:
        print(film_run(values, overrides))
    except (ValueError, OSError) as error:
        sys.exit(f"error: {error}")
    except KeyboardInterrupt:
        sys.exit("stopped: no film was written")


if __name__ == "__main__":
    main()
