"""Says in which folder the course's datasets, trained agents and results are.

In a clone they are in its `data/`. An installed package has none of them, because they are 120 MB. Then
`c2iql fetch --course` puts them into a folder in the user's home, or C2IQL_DATA names any other folder.
"""

import os
from pathlib import Path

VARIABLE = "C2IQL_DATA"
"""The environment variable that names the folder. It goes before all other places."""
ROOT = Path(__file__).resolve().parents[2]
"""The folder that has this package: the clone, or the `site-packages` of an installation."""
USER_FOLDER = "~/.c2iql"
"""The folder of an installation: the same name on every system, beside DSRL's ~/.dsrl."""


def data_folder() -> Path:
    """Returns the folder of the datasets, agents and results. It may be missing.

    It is what C2IQL_DATA names, else `data/` of the clone in which this package is, else ~/.c2iql. No other
    place is tried where a file is not in this folder: otherwise the same command could use different data on
    two machines.
    """
    named = os.environ.get(VARIABLE)
    if named:
        return Path(os.path.expanduser(named)).absolute()
    return ROOT / "data" if in_clone() else Path(os.path.expanduser(USER_FOLDER))


def in_clone() -> bool:
    """Is this package in a clone of the project? A folder `data` alone could be anybody's."""
    return (ROOT / "environment.lock").is_file() and (ROOT / "data").is_dir()


def why_missing(path: Path) -> str:
    """Returns one line for a course's file that is not there: its path, the reason, and what to do."""
    if os.environ.get(VARIABLE):
        return f"{path}: not in the folder that {VARIABLE} names: correct {VARIABLE}, or unset it"
    if in_clone():
        return f"{path}: not shipped with the project"
    remedy = f"`c2iql fetch --course` brings it, or set {VARIABLE} to the data/ of a clone"
    return f"{path}: this package was installed without its data: {remedy}"
