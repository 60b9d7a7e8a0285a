"""The command line: `c2iql tasks | collect | fetch | data | train | evaluate | certify | capstone | ...`.

tyro makes commands with types and help from functions and dataclasses, so each option is written only once.
"""

import sys
from importlib.metadata import version

import tyro

from tutorial_lib.commands.agents import capstone, certify, evaluate, train
from tutorial_lib.commands.data import collect, data, fetch, tasks
from tutorial_lib.commands.studies import report, study

COMMANDS = {
    f.__name__: f for f in (tasks, collect, fetch, data, train, evaluate, certify, capstone, study, report)
}


def main() -> None:
    """Runs the command line. An error that a person can cause is one line, and the exit status is then 2."""
    words = sys.argv[1:]
    if words == ["--version"]:
        print(f"c2iql {version('c2iql-tutorial')}")
        return
    try:
        _run(words)
    except KeyboardInterrupt:
        _stop("stopped: run the command again to continue", status=130)
    except (ValueError, OSError, ArithmeticError, MemoryError, RuntimeError) as error:
        text = str(error) or type(error).__name__
        small = isinstance(error, MemoryError) or "allocate memory" in text or "out of memory" in text
        _stop(f"the memory is too small: choose smaller options ({text})" if small else text)


def _run(words: list[str]) -> None:
    """Runs the command that the words name."""
    parsers = {"train": train, "data": data}  # their options depend on their first arguments
    if words and words[0] in parsers:
        parsers[words[0]](tuple(words[1:]))
    else:
        tyro.extras.subcommand_cli_from_dict(
            COMMANDS, prog="c2iql", description="Safe offline reinforcement learning with C2IQL."
        )


def _stop(text: str, status: int = 2) -> None:
    """Closes the progress bars, prints an error in a line of its own, and ends the program."""
    if "tqdm" in sys.modules:
        for bar in list(sys.modules["tqdm"].tqdm._instances):
            bar.close()
    print(f"c2iql: {' '.join(text.split())}", file=sys.stderr)
    sys.exit(status)


if __name__ == "__main__":
    main()
