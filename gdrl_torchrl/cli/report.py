"""``gdrl-report study=<name>`` or ``runs=<folder>``: a page on what runs have shown."""

from __future__ import annotations

from pathlib import Path

from gdrl_torchrl.cli.shared.arguments import CommandParser, fail

_OPTIONS = {
    "study": "Report on a study: on the folder of this name in results=, and nothing else.",
    "runs": "Report on all runs below a folder instead, whatever they are.",
    "fill": "Fill in the figures of studies that are marked in a file of Markdown, or in "
    "all below a folder, instead: docs/reports.md says how.",
    "results": "Folder of the results of studies; results if it is not given.",
    "out": "Folder of the report; that of the study's results, or report in that of the "
    "runs, if it is not given.",
}
_PARSER = CommandParser(
    "gdrl-report",
    "study=<name>|runs=<folder>|fill=<path> [results=<folder>] [out=<folder>]",
    "Compare methods over seeds: a page for the browser (report.html), the same as "
    "Markdown (report.md), its figures (figures/*.svg). The last line printed is the page.",
    [("arguments", [(f"{name}=<...>", meaning) for name, meaning in _OPTIONS.items()])],
    [
        "gdrl-report study=pilot",
        "gdrl-report runs=runs/trials out=/tmp/trials",
        "gdrl-report fill=docs",
    ],
)


def values_in(arguments: list[str]) -> dict[str, str]:
    """The arguments by name.

    Raises:
        ValueError: If one is unknown or given twice, or not one of study and runs is given.

    Examples:
        >>> values_in(["study=pilot", "out=page"])
        {'study': 'pilot', 'out': 'page'}
    """
    values: dict[str, str] = {}
    for argument in arguments:
        name, _, value = argument.partition("=")
        if name not in _OPTIONS or not value:
            known = ", ".join(f"{name}=..." for name in _OPTIONS)
            raise ValueError(f"{argument} must be one of {known}: see gdrl-report --help")
        if name in values:
            raise ValueError(f"{argument} must be given once")
        values[name] = value
    asked = [name for name in ("study", "runs", "fill") if name in values]
    if len(asked) != 1:
        given = " ".join(arguments) or "nothing"
        raise ValueError(f"{given}: one of study=, runs= and fill= must be given")
    for other, name in (("runs", "results"), ("fill", "out")):
        if other in values and name in values:
            raise ValueError(f"{name}={values[name]} must not be given beside {other}=")
    return values


def report(values: dict[str, str]) -> Path:
    """Write the report that is asked for.

    Returns:
        The page of HTML.

    Raises:
        ValueError: If there is nothing to report on, or a file is damaged.
        OSError: If the report cannot be written.
    """
    # These take a second to import: arguments are checked before.
    if "runs" in values:
        from gdrl_torchrl.reports.of_runs import runs_evidence

        evidence = runs_evidence(values["runs"])
        folder = Path(values["runs"], "report")
    else:
        from gdrl_torchrl.reports.of_study import read_study

        folder = Path(values.get("results", "results"), values["study"])
        evidence = read_study(folder)
    # Last, for it imports what draws: what cannot be read is said before.
    from gdrl_torchrl.reports.report import write_report

    return write_report(evidence, Path(values.get("out", folder)))


def main() -> None:
    """Entry point of ``gdrl-report``."""
    try:
        values = values_in(_PARSER.parse_args().arguments)
        if "fill" not in values:
            print(report(values))
            return
        from gdrl_torchrl.reports.fill import fill_files

        results = Path(values.get("results", "results"))
        for path in fill_files(Path(values["fill"]), results):
            print(path)
    except (ValueError, OSError) as error:
        fail(error)


if __name__ == "__main__":
    main()
