"""Bad inputs: each is made of a good one, given to a command, and must end in one clear line, with no loss.

Hypothesis draws the faults. Every case is wrong by construction, so a command that accepts it is at fault.
"""

import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import pandas as pd
from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis import strategies as st

from benchmarks.reliability import answers, damage, rows, words
from benchmarks.reliability.processes import Work, called, contents, run, typed
from benchmarks.reliability.samples import TINY, make_samples
from tutorial_lib.data import sources
from tutorial_lib.studies.results import read_results

SECONDS = 60
"""A command that takes longer hangs: a good input of this size takes at most a second or two."""


class Case(NamedTuple):
    """One bad input."""

    words: str
    """What is wrong."""
    work: Work
    """The command that gets it."""
    damage: Callable[[Path], object] = lambda folder: None
    """Makes the bad input of the good ones in the case's folder."""


class Kind(NamedTuple):
    """A kind of bad input."""

    name: str
    count: int
    """The number of cases of a full trial."""
    cases: st.SearchStrategy[Case]


TRAIN = ("train", "IQL", "BallRun", "--out", "new", *TINY, "--updates", 1)
EVALUATE = ("--episodes", 1, "--workers", 1, "--limits", 40, "--out", "new.csv")


def _of_file(name: str, faults: st.SearchStrategy[damage.Fault], work: Work) -> st.SearchStrategy[Case]:
    """Cases in which one of the good files has a fault."""
    return faults.map(lambda fault: Case(fault.words, work, lambda folder: fault.make(folder / name)))


def _of_words(lines: st.SearchStrategy[tuple]) -> st.SearchStrategy[Case]:
    """Cases in which the command line itself is wrong."""
    return lines.map(lambda line: Case(" ".join(map(str, line)), typed(*line)))


def _train_on_shipped() -> None:
    """Trains on `data.hdf5` as if the project had shipped it: there is a file with its checksum."""
    sources.SHIPPED_DATA = Path.cwd() / "shipped"
    typed(*TRAIN)()


def _convert() -> Work:
    return typed("data", "convert", "episodes", "--out", "new.hdf5", "--task", "BallRun")


def kinds(address: str, folder: Path) -> list[Kind]:
    """All kinds of bad inputs. A server at `address` serves what is in `folder`."""
    resumed = typed("train", "IQL", "BallRun", "--data", "data.hdf5", "--out", "run", *TINY, "--updates", 3)
    on_file, on_agent = (
        typed(*TRAIN, "--data", "data.hdf5"),
        typed("evaluate", "agent.safetensors", *EVALUATE),
    )
    on_results = called(read_results, Path("results.csv"))
    shipped, checkpoint = "shipped/BallRun.hdf5", "run/checkpoint.safetensors"
    return [
        Kind("an option of training", 60, _of_words(words.wrong_options())),
        Kind("an argument of a command", 60, _of_words(words.wrong_arguments())),
        Kind("a dataset", 90, _of_file("data.hdf5", damage.of_datasets(), on_file)),
        Kind("a shipped dataset with one wrong bit", 20, _of_file(shipped, damage.FLIPS, _train_on_shipped)),
        Kind("a recording to convert", 30, _of_file("episodes/0.csv", rows.of_recordings(), _convert())),
        Kind("an agent", 70, _of_file("agent.safetensors", damage.of_agents(), on_agent)),
        Kind("the checkpoint of a run", 20, _of_file(checkpoint, damage.of_checkpoints(), resumed)),
        Kind("a table of results", 50, _of_file("results.csv", rows.of_results(), on_results)),
        Kind("a server's answer", 20, answers.wrong(address, folder).map(lambda answer: Case(*answer))),
    ]


def drawn(cases: st.SearchStrategy[Case], count: int) -> list[Case]:
    """Different cases, at most `count`, and always the same ones."""
    found: dict[str, Case] = {}

    @seed(0)
    @settings(
        max_examples=3 * count,
        database=None,
        deadline=None,
        suppress_health_check=list(HealthCheck),
        phases=[Phase.generate],
    )
    @given(cases)
    def keep(case: Case) -> None:
        found.setdefault(case.words, case)

    keep()
    return list(found.values())[:count]


def tried(case: Case, samples: Path, folder: Path) -> tuple[str, bool, str]:
    """Gives a case to its command in `folder`. Returns the verdict, whether a file was lost, and the output.

    A file is lost if it is another one afterwards, or gone. A refused command also must leave no new file.
    """
    shutil.copytree(samples, folder)
    case.damage(folder)
    before = contents(folder)
    ended = run(case.work, folder, SECONDS)
    after = contents(folder)
    kept = {name: after.get(name) for name in before} if ended.verdict == "accepted" else after
    return ended.verdict, kept != before, (ended.out + ended.err)[-2000:]


def trials(share: float = 1.0, work: Path | None = None) -> pd.DataFrame:
    """Tries a share of the cases of each kind. One row per case: kind, words, verdict, lost, output."""
    tried_cases = []
    with tempfile.TemporaryDirectory(dir=work) as scratch:
        root = Path(scratch)
        samples = make_samples(root / "samples")
        (root / "served").mkdir()
        with answers.server(root / "served") as address:
            for kind in kinds(address, root / "served"):
                for case in drawn(kind.cases, max(2, round(share * kind.count))):
                    folder = root / f"{len(tried_cases)}"
                    verdict, lost, output = tried(case, samples, folder)
                    tried_cases.append((kind.name, case.words, verdict, lost, output))
                    shutil.rmtree(folder)
    return pd.DataFrame(tried_cases, columns=["kind", "words", "verdict", "lost", "output"])
