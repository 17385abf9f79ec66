"""`lunar-mjx train`, `evaluate` and `play`: reinforcement learning from the command line."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Annotated, Any

import typer

from lunar_mjx.agents import FINAL_SEED
from lunar_mjx.commands.options import MOST_SEED
from lunar_mjx.errors import bad_input, require_within
from lunar_mjx.files import write_text

DeviceOption = Annotated[str, typer.Option(help="auto, cpu or cuda.")]
SetOption = Annotated[list[str] | None, typer.Option("--set", help="name=value: a field of the training's settings.")]
EnvSetOption = Annotated[
    list[str] | None, typer.Option("--env", help="name=value: an option of the environment, as JSON or text.")
]

MOST_EPISODES = 1_000_000
"""Side by side on one device; their states alone take gigabytes."""


def pairs(option: str, texts: list[str] | None) -> dict[str, str]:
    """Name and value of `name=value` texts."""
    found = {}
    for text in texts or []:
        name, equals, value = text.partition("=")
        if not equals or not name:
            raise bad_input("lunar-mjx", option, text, "is not name=value", f"write {option} name=value")
        found[name] = value
    return found


def env_options(texts: list[str] | None) -> dict[str, Any]:
    """Options of an environment from `name=value` texts; a value is JSON where it reads as JSON, else text."""
    options: dict[str, Any] = {}
    for name, text in pairs("--env", texts).items():
        try:
            value = json.loads(text)
        except (ValueError, RecursionError):
            value = text
        options[name] = tuple(value) if isinstance(value, list) else value
    return options


def train(
    training: Annotated[str, typer.Argument(help="A training by name (--list), or my_training.toml.")] = "large-td3",
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder to write to, and to resume from.")] = Path(
        "runs/train"
    ),
    learner: Annotated[
        str | None, typer.Option(help="td3, ddpg, sac or ppo instead of the training's own, with settings to match.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, max=MOST_SEED)] = 0,
    steps: Annotated[
        int | None, typer.Option(min=1, max=10**15, help="Environment steps; the training's own if left out.")
    ] = None,
    time_limit: Annotated[float | None, typer.Option(help="s after which it saves and stops, to be resumed.")] = None,
    target: Annotated[float | None, typer.Option(help="Success rate on unseen ground at which it stops.")] = None,
    environment: Annotated[
        str | None, typer.Option(help="Environment instead: a name, or my_env.py:make_env, run as your own code.")
    ] = None,
    settings: SetOption = None,
    env: EnvSetOption = None,
    eval_every: Annotated[float, typer.Option(help="s of training between evaluations.")] = 30.0,
    eval_episodes: Annotated[int, typer.Option(min=1, max=MOST_EPISODES)] = 256,
    checkpoint_every: Annotated[float, typer.Option(help="s between checkpoints.")] = 300.0,
    begin_with: Annotated[
        str, typer.Option(help="Policy to begin with: policy.npz, or a shipped one (luvmi_x/ladder-3); PPO alone.")
    ] = "",
    restart: Annotated[bool, typer.Option(help="Begin anew although the folder has a checkpoint.")] = False,
    quiet: Annotated[bool, typer.Option(help="No progress.")] = False,
    list_: Annotated[bool, typer.Option("--list", help="List the trainings and stop.")] = False,
    device: DeviceOption = "auto",
    coordinator: Annotated[
        str | None, typer.Option(help="HOST:PORT of the first process, where several hosts train together.")
    ] = None,
    processes: Annotated[int, typer.Option(min=1, help="How many processes train together.")] = 1,
    process: Annotated[int, typer.Option(min=0, help="Which of them this is, from 0; the first writes the files.")] = 0,
) -> None:
    """Train a policy; resumes from the folder's newest checkpoint."""
    from lunar_mjx.commands.options import check_folder, make_folder, select_device

    check_folder(out)
    require_within("train", "--eval-every", eval_every, 0.0)
    # Not require_within: inf is a sensible answer here.
    if math.isnan(checkpoint_every) or checkpoint_every < 0.0:
        raise bad_input("train", "--checkpoint-every", checkpoint_every, "is no time", "give s, or inf for none")
    if time_limit is not None:
        require_within("train", "--time-limit", time_limit, 0.0, above=True)
    if target is not None:
        require_within("train", "--target", target, 0.0, 1.0)
    select_device(device)
    import dataclasses

    from lunar_mjx.agents.configs import get_training, override, training_names

    if list_:
        for name in training_names():
            print(f"{name:12} {get_training(name).note}")
        return
    chosen = override(get_training(training, learner), **pairs("--set", settings))
    options = env_options(env)
    if environment is not None:
        # The training's options and unseen ground belong to the environment that it brought.
        chosen = dataclasses.replace(chosen, environment=environment, options=options, unseen={})
    elif options:
        chosen = dataclasses.replace(chosen, options={**chosen.options, **options})
    from lunar_mjx.together import join, leads

    # Before anything asks for devices: JAX must know its fellow processes by then.
    join(coordinator, processes, process)
    from lunar_mjx.agents.evaluate import success_text
    from lunar_mjx.agents.run import run_training, soil_note
    from lunar_mjx.agents.train import RunConfig

    run = RunConfig(steps or chosen.steps, seed, time_limit, checkpoint_every, not restart, quiet, begin_with)
    report = run_training(training, chosen, run, make_folder(out), eval_every, eval_episodes, target)
    # All processes hold the same score; one is to tell it.
    if not leads():
        return
    score = report.score
    print(
        f"success on unseen ground {success_text(score.record())} of {score.episodes} episodes, "
        f"return {score.episode_return:.1f}"
    )
    if note := soil_note(report.result.learner.env):
        print(note)
    if not report.result.finished:
        print("time limit reached; the same command resumes")
    print(out / "policy.npz")


AgentArgument = Annotated[
    str,
    typer.Argument(
        help="policy.npz, a shipped policy (luvmi_x, viper, luvmi_x/ladder-3, luvmi_x/escape), or zero, random, "
        "scripted, rocking, reactive, mapper, planner."
    ),
]
AgentOption = Annotated[str | None, typer.Option("--agent", help="The same as an option, for agents without a policy.")]
TaskOption = Annotated[
    str, typer.Option(help="Task for agents without a policy: paper, consistent, large, escape, ladder/1 to ladder/5.")
]


SHIPPED_AGENT = "luvmi_x"


def one_agent(source: str, argument: str, option: str | None) -> str:
    """The agent that was named to the verb `source`, as an argument or as an option."""
    # The default of the argument cannot be told from the same name typed.
    if option is not None and argument not in (SHIPPED_AGENT, option):
        raise bad_input(source, "--agent", option, f"is given beside {argument!r}", "name one agent")
    return argument if option is None else option


def evaluate(
    agent: AgentArgument = SHIPPED_AGENT,
    agent_option: AgentOption = None,
    episodes: Annotated[int, typer.Option(min=1, max=MOST_EPISODES)] = 256,
    seed: Annotated[int, typer.Option(min=0, max=MOST_SEED)] = FINAL_SEED,
    task: TaskOption = "large",
    terrain: Annotated[str | None, typer.Option(help="Terrain; the policy's unseen one if left out.")] = None,
    seen: Annotated[bool, typer.Option(help="On the ground and soil of the training instead.")] = False,
    env: EnvSetOption = None,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="JSON file to write.")] = None,
    device: DeviceOption = "auto",
) -> None:
    """Score an agent: success rate with its 95 % interval, on unseen ground, goals and soil."""
    from lunar_mjx.commands.options import select_device

    select_device(device)
    from lunar_mjx.agents.evaluate import Evaluator, success_text
    from lunar_mjx.agents.play import knowing, open_agent
    from lunar_mjx.agents.run import soil_note, unseen_params

    wanted = one_agent("evaluate", agent, agent_option)
    made, act, unseen = open_agent(wanted, task, env_options(env))
    if terrain is not None:
        unseen = {**unseen, "terrain": terrain}
    params = made.params if seen and terrain is None else unseen_params(made, {} if seen else unseen)
    # After the ground is chosen: agents that know the map must know this one.
    act = knowing(wanted, made, params, act)
    score = Evaluator(made, lambda _, state, key: act(state, key), episodes)(params, (), seed)
    print(
        f"success {success_text(score.record())} of {score.episodes} episodes, return {score.episode_return:.1f} "
        f"+- {score.return_deviation:.1f}, {score.episode_time:.1f} s an episode"
    )
    print(", ".join(f"{name} {100 * share:.1f} %" for name, share in score.ends.items()))
    if not seen and (note := soil_note(made)):
        print(note)
    if score.spl is not None:
        print(
            f"success weighted by path length {score.spl:.3f}, {score.collisions_per_km:.1f} collisions/km, "
            f"{score.wh_per_km:.0f} Wh/km, mean slip {score.slip:.2f}"
        )
    if out is not None:
        out.parent.mkdir(parents=True, exist_ok=True)
        write_text(out, json.dumps({"agent": wanted, **score.record()}, indent=1) + "\n")
        print(out)


def play(
    agent: AgentArgument = SHIPPED_AGENT,
    agent_option: AgentOption = None,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder to write to.")] = Path("runs/play"),
    seed: Annotated[int, typer.Option(min=0, max=MOST_SEED)] = 0,
    task: TaskOption = "large",
    terrain: Annotated[str | None, typer.Option(help="Terrain; the policy's unseen one if left out.")] = None,
    view: Annotated[str, typer.Option(help="camera (needs OpenGL), top, or auto: camera where it works.")] = "auto",
    env: EnvSetOption = None,
    device: DeviceOption = "auto",
) -> None:
    """Drive one episode and write a video of it."""
    from lunar_mjx.commands.options import check_folder, make_folder, select_device

    check_folder(out)
    select_device(device)
    from lunar_mjx.agents.play import knowing, open_agent, play_episode, require_view
    from lunar_mjx.agents.run import unseen_params

    require_view(view)
    wanted = one_agent("play", agent, agent_option)
    made, act, unseen = open_agent(wanted, task, env_options(env))
    if terrain is not None:
        unseen = {**unseen, "terrain": terrain}
    params = unseen_params(made, unseen)
    episode = play_episode(made, params, knowing(wanted, made, params, act), seed)
    print(episode.sentence)
    for path in episode.write(make_folder(out), view):
        print(path)


def register(app: typer.Typer) -> None:
    """Adds the commands to the application."""
    app.command()(train)
    app.command()(evaluate)
    app.command()(play)
