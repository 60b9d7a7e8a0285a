"""Makes what the site's first page shows: an episode that moves under a visitor's limit, and the results."""

import hashlib
import json
import shutil
from pathlib import Path

import pandas as pd
from moving import control_html
from PIL import Image

from tutorial_lib.checkpoints import load_agent
from tutorial_lib.course.figures import film
from tutorial_lib.data import SHIPPED_DATA
from tutorial_lib.studies.paper import TABLE1
from tutorial_lib.studies.report import markdown, pair
from tutorial_lib.studies.results import SCORES, load_results, over_seeds

AGENT = SHIPPED_DATA / "agents" / "BallCircle.safetensors"
LIMITS, SEED, EVERY = (10, 30, 70), 10, 5  # unsafe steps; the start; a picture of every fifth step
BUTTON = '<button type="button" class="play">Play</button>'


def teaser(folder: Path, address: str) -> str:
    """Returns the HTML of a control that shows the shipped agent's episode under each of three limits.

    The episodes are played and filmed unless `folder` has their pictures already. `address` is that of the
    folder, from the page.
    """
    made_of = hashlib.sha256(AGENT.read_bytes() + repr((LIMITS, SEED, EVERY)).encode()).hexdigest()
    stored = folder / "control.json"
    control = json.loads(stored.read_text("utf-8")) if stored.is_file() else {}
    if control.get("made_of") != made_of:
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        control = _film(folder) | {"made_of": made_of}
        stored.write_text(json.dumps(control), encoding="utf-8")
    words = control["texts"][0]
    return control_html(control, address, BUTTON, f'<p class="words">{words}</p>')


def _film(folder: Path) -> dict:
    """Plays an episode under each limit and writes its pictures. Returns the control (see pictures.py)."""
    agent = load_agent(AGENT)
    steps, pictures, texts = range(0, agent.task.horizon, EVERY), [], []
    for limit in LIMITS:
        frames, costs = film(agent, limit, SEED, steps)
        for step, frame, cost in zip(steps, frames, costs, strict=True):
            name = f"{limit}-{step}.jpg"
            Image.fromarray(frame).save(folder / name, quality=80)
            pictures.append(name)
            texts.append(f"At most {limit} unsafe steps: after {step} steps, {cost:.0f} were unsafe.")
    sliders = [
        {"name": "limit", "labels": [f"{limit}" for limit in LIMITS], "start": 0},
        {"name": "step", "labels": [f"{step}" for step in steps], "start": 0},
    ]
    return {"sliders": sliders, "pictures": pictures, "texts": texts}


def results() -> str:
    """Returns the table of C2IQL's and cloning's mean scores in Markdown, from data/results/table1.csv."""
    found = over_seeds(load_results("table1")).set_index(["algorithm", "task"])
    rows = []
    for task in found.loc["C2IQL"].index:
        row = {"task": task}
        for name, title in (("C2IQL", "C2IQL"), ("BC-Safe", "cloning of safe episodes")):
            row[title] = pair(*found.loc[(name, task), list(SCORES)])
        rows.append(row | {"the paper's C2IQL, on other data": pair(*TABLE1["C2IQL"][task])})
    return markdown(pd.DataFrame(rows))
