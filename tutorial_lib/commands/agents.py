"""The commands that train and play agents: `c2iql train | evaluate | certify | capstone`."""

from pathlib import Path

import tyro

from tutorial_lib.commands import check_counts, check_device, check_limits, check_memory


def train(words: tuple[str, ...] = ()) -> None:
    """Train an agent and save it with its log: `c2iql train [ALGORITHM] TASK [options]`.

    Several seeds train together. A run that was killed continues from its last checkpoint when you run the
    command again. Without options, the command trains with the settings of the table of results.
    `c2iql train ALGORITHM --help` shows all options of an algorithm. The default algorithm is C2IQL.
    """
    from tutorial_lib import checkpoints, training
    from tutorial_lib.agents import slug
    from tutorial_lib.data import load_dataset
    from tutorial_lib.files import held
    from tutorial_lib.options import parse_training
    from tutorial_lib.tasks import get_task

    kind, args = parse_training(list(words))
    task = get_task(args.task)
    if args.limits and not kind.needs_limit:
        raise ValueError(f"--limits: {kind.name} is trained for no limit; it is told one when it plays")
    if not args.seeds:
        raise ValueError("--seeds: give at least one")
    if not all(0 <= seed < 2**63 for seed in args.seeds):
        raise ValueError("--seeds: each must be from 0 to 2^63 - 1")
    device = check_device(args.device)
    limits = (args.limits or task.thresholds) if kind.needs_limit else ()
    of_runs = tuple(limit for limit in limits for _ in args.seeds) or None
    seeds = args.seeds * (len(limits) or 1)
    check_memory(kind, task, args.config, seeds, of_runs)
    agent = kind(task, args.config, seeds, of_runs, device)
    suffix = "".join(f"-{limit:g}" for limit in args.limits)
    out = args.out or Path("runs") / task.name / f"{slug(kind.name)}{suffix}-{args.config.profile}"
    with held(out):
        training.train(agent, load_dataset(task, args.data), run_dir=out)
        checkpoints.save_agent(agent, out / "agent.safetensors")
    log = out / checkpoints.METRICS
    print(f"{out}/agent.safetensors: trained for {agent.updates} updates; its log is {log}")


def evaluate(
    agent: tyro.conf.Positional[Path],
    out: Path | None = None,
    limits: tuple[float, ...] | None = None,
    episodes: int = 10,
    workers: int = 2,
) -> None:
    """Run a trained agent in the simulator, print its scores and save the results of every episode.

    Args:
        agent: This is the path of an agent.safetensors or a checkpoint.safetensors.
        out: The results are written to this CSV. The default is beside the agent, e.g. agent-results.csv.
        limits: These are limits of the episode cost. The default is the limits for which the agent was
            trained, or the task's own limits.
        episodes: This is the number of episodes per run and limit.
        workers: This is the number of processes. The results do not depend on it.
    """
    from tutorial_lib import checkpoints, playing, scores
    from tutorial_lib.files import check_output

    check_counts(episodes=episodes, workers=workers)
    out = out or agent.with_name(f"{agent.stem}-results.csv")
    if out.is_dir():
        raise ValueError(f"--out {out}: is a folder: name a file")
    check_output(out)
    check_limits(limits)
    results = playing.evaluate(checkpoints.load_agent(agent), limits, episodes, workers)
    print(scores.summarise(results).round(3).to_string(index=False))
    print("(low, high: 95% bootstrap intervals over episodes, all seeds pooled)")
    scores.save_results(results, out)
    print(f"{out}: {len(results)} episodes")


def certify(
    agent: tyro.conf.Positional[Path],
    limits: tuple[float, ...] | None = None,
    episodes: int = 50,
    workers: int = 2,
    out: Path | None = None,
) -> None:
    """Play an agent in states that nothing was chosen on, and say what it keeps, with intervals.

    For each run and limit, the command prints the mean cost of an episode with its 95% interval, the chance
    that an episode exceeds the limit with its exact 95% interval (Clopper and Pearson), and the cost that the
    agent predicted at the first step.

    Args:
        agent: This is the path of an agent.safetensors or a checkpoint.safetensors.
        limits: These are limits of the episode cost. The default is the limits for which the agent was
            trained, or the task's own limits.
        episodes: This is the number of episodes per run and limit.
        workers: This is the number of processes. The results do not depend on it.
        out: The table is written to this CSV. By default it is only printed.
    """
    from tutorial_lib import checkpoints, playing, scores
    from tutorial_lib.files import check_output

    check_counts(episodes=episodes, workers=workers)
    check_limits(limits)
    if out:
        check_output(out)
    results = playing.evaluate(checkpoints.load_agent(agent), limits, episodes, workers, held_out=True)
    table = scores.certificate(results)
    print(table.round(3).to_string(index=False))
    print("(low, high: 95% intervals. predicted: what the agent expected at the first step.)")
    if out:
        scores.save_results(table, out)
        print(f"wrote {out}")


def capstone(agent: tyro.conf.Positional[Path], out: Path | None = None, workers: int = 2) -> None:
    """Score an agent of your own: frozen starts, each limit of its task, and a bar to beat.

    The bar is the normalised reward that the shipped C2IQL and two kinds of cloning have at the cost that
    your agent pays. It is read from the results of study table1. The command prints a table and a verdict.

    Args:
        agent: This is the path of an agent.safetensors, or of a folder with one for each limit or seed.
        out: The scores are written to this JSON, for a teacher. The default is beside the agent, e.g.
            agent-capstone.json.
        workers: This is the number of processes. The results do not depend on it.
    """
    from tutorial_lib.files import check_output
    from tutorial_lib.studies import capstone as scoring

    check_counts(workers=workers)
    out = out or (
        agent / "capstone.json" if agent.is_dir() else agent.with_name(f"{agent.stem}-capstone.json")
    )
    check_output(out)
    agents = scoring.load(agent)
    reference = scoring.references(agents[0].task.name)
    table = scoring.score(scoring.play(agents, workers), reference)
    lines = scoring.verdict(table)
    print(table.round(3).to_string(index=False))
    print("(reward, cost: normalised. low, high: 95% bootstrap intervals over episodes, all seeds pooled)")
    print("\n".join(lines))
    if missing := [name for name in scoring.REFERENCES if name not in set(reference["algorithm"])]:
        print(f"Not in the bar, because study table1 has no results of it: {', '.join(missing)}.")
    if scoring.trained_on_shipped_data(agents) is False:
        print("It was not trained on the shipped recordings of its task: by the rules it does not count.")
    scoring.save_report(agents, table, lines, out)
    print(f"wrote {out}")
