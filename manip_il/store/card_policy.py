"""The card of a policy: a `pretrained_model` folder, or a run that holds one."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from huggingface_hub import EvalResult, ModelCardData

from manip_il import checks
from manip_il.data.lerobot_layout import INFO
from manip_il.data.lerobot_read import dataset_info
from manip_il.data.schema import ENVIRONMENT_STATE
from manip_il.errors import ManipError
from manip_il.store.card_text import LICENSE, REPOSITORY, command, fingerprint_rows, repository, table
from manip_il.store.front import CONFIG, policy_folder

_PLACES = tuple(
    f"{folder}{CONFIG}" for folder in ("", "pretrained_model/", "*/pretrained_model/", "*/*/pretrained_model/")
)
_LEVELS = re.compile(r"pretrained_model|policy|best|last|checkpoints|\d+")  # folders of one run, above its weights
_TAUGHT = "Taught by an inverse-kinematics expert in MuJoCo; there were no human demonstrations.\n\n"
_PLUGIN = "manip_il.lerobot_plugin"  # our robots and policies in LeRobot's own commands
_DATASET = "dataset"  # of a DAgger run: what its policy was fitted to
_REPO_ID = re.compile(r"[\w.-]+/[\w.-]+")


@dataclass(frozen=True)
class Policy:
    """What a folder says of its policy; `{}` for what is not there."""

    config: Mapping[str, Any]
    meta: Mapping[str, Any]
    training: Mapping[str, Any]
    evaluation: Mapping[str, Any]
    chosen_by: bool  # whether the evaluation is one that the policy was chosen by

    @property
    def type(self) -> str:
        """LeRobot's name for it."""
        return str(self.config.get("type", "policy"))

    def named(self, key: str) -> str:
        """Return its `robot` or `task`; empty where nothing says it."""
        return str(self.meta.get(key) or self.evaluation.get(key) or "")

    @property
    def robot_task(self) -> tuple[str, str]:
        """Both names."""
        return self.named("robot"), self.named("task")


def policy_card(root: Path, url: str) -> str:
    """`README.md`. Raises `ManipError` for a folder without a policy, or whose files say what no policy's do."""
    policy = read_policy(root)
    try:
        return _card(root, policy, url)
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise ManipError(
            f"{root}: its card cannot be written, as a JSON file beside the policy holds unexpected values "
            f"({type(error).__name__}: {checks.shorten(str(error))}); restore the file"
        ) from error


def _card(root: Path, policy: Policy, url: str) -> str:
    place = repository(url)
    robot, task = policy.robot_task
    title = f"{policy.type} for {robot} {task}" if robot else policy.type
    made = command(root / "config.yaml")
    steps = f"```sh\n{made}\n```\n\n" if made else ""
    return (
        f"---\n{_metadata(policy, title).to_yaml()}\n---\n\n# {title}\n\n"
        f"{_TAUGHT if policy.meta else ''}{table(_rows(root, policy))}\n\n## Use\n\n{_use(policy, place)}"
        f"## How it was made\n\n{steps}{fingerprint_rows(policy.meta.get('fingerprint') or {})}"
    )


def read_policy(root: Path) -> Policy:
    """Return the policy in a folder, or in the run that the folder is. Raises `ManipError` where there is none."""
    inside = policy_folder(path.relative_to(root).as_posix() for place in _PLACES for path in root.glob(place))
    if inside is None:
        raise ManipError(f"no policy in {root}; push a run that has saved a checkpoint, or a pretrained_model folder")
    folder = root / inside
    evaluation, chosen_by = _evaluation(root, folder)
    config, meta, training = (_read(folder / f"{name}.json") for name in ("config", "manip_il", "train_config"))
    return Policy(config, meta, training, evaluation, chosen_by)


def _metadata(policy: Policy, title: str) -> ModelCardData:
    robot, task = policy.robot_task
    tags = dict.fromkeys(["robotics", "lerobot", "manip_il", policy.type, robot, task])
    results = None
    if "success_rate" in policy.evaluation:
        rate, name = float(policy.evaluation["success_rate"]), f"{robot} {task}".strip() or "unknown"
        result = EvalResult("robotics", "manip_il", name, "success_rate", rate, metric_name="success rate")
        results = [result]
    return ModelCardData(
        license=LICENSE,
        library_name="lerobot",
        pipeline_tag="robotics",
        tags=[tag for tag in tags if tag],
        model_name=title.replace(" ", "_"),
        datasets=_dataset(policy),
        eval_results=results,
    )


def _dataset(policy: Policy) -> str | None:
    """USER/NAME of what it was trained on, where that is a name on the Hub."""
    name = str((policy.training.get("dataset") or {}).get("repo_id") or "")
    return name if _REPO_ID.fullmatch(name) and not name.startswith("local/") else None


def _rows(root: Path, policy: Policy) -> Iterator[tuple[str, object]]:
    meta, training = policy.meta, policy.training
    robot, task = policy.robot_task
    yield "policy", f"`{policy.type}`"
    if robot:
        yield "robot, task", f"`{robot}`, `{task}`"
    yield "sees", ", ".join(f"`{key}`" for key in policy.config.get("input_features") or {}) or "nothing"
    if meta.get("cameras"):
        height, width = meta.get("image_size", (0, 0))
        yield "cameras", f"{', '.join(meta['cameras'])}, {width} x {height} pixels"
    if meta.get("action_meaning"):
        yield "action", f"{meta['action_meaning']}, {meta.get('fps', '?')} a second"
    if name := str((training.get("dataset") or {}).get("repo_id") or ""):
        yield "learnt from", f"`{name}`"
    elif (root / _DATASET / INFO).is_file():
        data = dataset_info(root / _DATASET)
        yield "learnt from", f"{data.episodes:,} episodes, {data.frames:,} frames"
    yield from _fit(policy)
    yield "success", _success(policy)


def _fit(policy: Policy) -> Iterator[tuple[str, object]]:
    options = {**(policy.meta.get("options") or {}), **policy.training}
    words = [text.format(options[key]) for key, text in _FIT.items() if options.get(key) is not None]
    if words:
        yield "fit", ", ".join(words)


_FIT = {"steps": "{} steps", "batch_size": "batches of {}", "lr": "learning rate {}", "seed": "seed {}"}


def _success(policy: Policy) -> str:
    found = policy.evaluation
    if "success_rate" not in found:
        return "not measured; see below"
    low, high = found.get("interval") or (float("nan"), float("nan"))
    sure = float(found.get("confidence", 0.95))
    count = f"{found['n_episodes']:,} episodes"
    text = f"**{found['success_rate']:.1%}** [{low:.1%}, {high:.1%}] ({sure:.0%} interval, {count})"
    return f"{text}, on the seeds that it was chosen on" if policy.chosen_by else f"{text}, on unseen seeds"


def _use(policy: Policy, place: str) -> str:
    named = [
        (key, policy.named(key)) for key in ("robot", "task") if not policy.meta.get(key)
    ]  # else it says so itself
    options = "".join(f" --{key}.type={name}" for key, name in named if name) + " --eval.n_episodes=200"
    folder = place.rpartition("/")[2] if place != REPOSITORY else "policy"
    return _USE.format(place=place, folder=folder, options=options, environment=_environment(policy))


def _environment(policy: Policy) -> str:
    """The options by which LeRobot's evaluator finds our robots; a word where the policy is of another robot."""
    if not policy.meta or not all(policy.robot_task):
        return "--env.type=..."
    task = "".join(word.capitalize() for word in "_".join(policy.robot_task).split("_"))
    words = [f"--env.discover_packages_path={_PLUGIN}", "--env.type=manip_il", f"--env.task={task}-v0"]
    if policy.meta.get("cameras"):
        height, width = policy.meta.get("image_size", (128, 128))
        both = ENVIRONMENT_STATE in (policy.config.get("input_features") or {})
        words += [
            f"--env.observation={'both' if both else 'images'}",
            f"--env.cameras={','.join(policy.meta['cameras'])}",
        ]
        words += [f"--env.observation_height={height}", f"--env.observation_width={width}"]
    return " \\\n  ".join([*words, "--eval.n_episodes=50"])


_USE = """```sh
manip-il pull hf://{place} runs/{folder}
manip-il eval --policy.path=runs/{folder}{options}
```

With LeRobot, straight from here:

```sh
lerobot-eval --policy.path={place} \\
  {environment}
```

In Docker, with no network and no privileges, after the pull:

```sh
mkdir -p out
docker run --rm --network=none --read-only --tmpfs /tmp --user "$(id -u):$(id -g)" \\
  -v ./runs/{folder}:/policy:ro -v ./out:/out \\
  manip-il eval --policy.path=/policy{options} \\
  --output_dir=/out/eval
```

"""


def _evaluation(root: Path, folder: Path) -> tuple[Mapping[str, Any], bool]:
    """The nearest `eval.json` beside the weights, up to the folder of their run; else one of the run's rounds."""
    place = folder.resolve()
    while True:
        found = [_read(path) for path in (place / "eval.json", *sorted(place.glob("eval*/eval.json")))]
        found = [one for one in found if _is_evaluation(one)]
        if found:
            return max(found, key=lambda one: one["n_episodes"]), place.name.startswith("round_")
        if not _LEVELS.fullmatch(place.name):
            break
        place = place.parent
    rounds = [_read(path) for path in sorted(root.glob("round_*/eval.json"))]
    rounds = [one for one in rounds if _is_evaluation(one)]
    return (max(rounds, key=lambda one: one["success_rate"]), True) if rounds else ({}, False)


def _is_evaluation(one: Mapping[str, Any]) -> bool:
    return all(isinstance(one.get(key), int | float) for key in ("success_rate", "n_episodes"))


def _read(path: Path) -> dict[str, Any]:
    """The object in a JSON file; empty where there is none."""
    try:
        return checks.read_json(path, "a JSON file beside a policy")
    except ManipError:
        return {}
