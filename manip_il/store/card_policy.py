"""Facts of a policy's card: a `pretrained_model` folder, or a run that holds one."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from huggingface_hub import EvalResult, ModelCardData

from manip_il import checks
from manip_il.data.lerobot_layout import INFO
from manip_il.data.lerobot_read import dataset_info
from manip_il.data.schema import ENVIRONMENT_STATE
from manip_il.errors import ManipError
from manip_il.store.push import CONFIG, policy_folder

_PLACES = tuple(
    f"{folder}{CONFIG}" for folder in ("", "pretrained_model/", "*/pretrained_model/", "*/*/pretrained_model/")
)
_LEVELS = re.compile(r"pretrained_model|policy|best|last|checkpoints|\d+")  # folders of one run, above its weights
_PLUGIN = "manip_il.lerobot_plugin"  # our robots and policies in LeRobot's own commands
_DATASET = "dataset"  # folder of a DAgger run: what its policy was fitted to
_REPO_ID = re.compile(r"[\w.-]+/[\w.-]+")
_FIT = {"steps": "{} steps", "batch_size": "batches of {}", "lr": "learning rate {}", "seed": "seed {}"}


class Policy:
    """JSON files of a policy's folder, each `{}` if it is missing, and the names in them, empty if none has one.

    type: LeRobot's name of its kind. dataset: LeRobot's `repo_id` of what it was trained on. was_chosen_by: whether the
    evaluation is one that the policy was chosen by.
    """

    def __init__(self, root: Path):
        """Read the policy in a folder, or in the run that the folder is. Raises `ManipError` if there is none."""
        inside = policy_folder(path.relative_to(root).as_posix() for place in _PLACES for path in root.glob(place))
        if inside is None:
            text = f"no policy in {root}; push a run that has saved a checkpoint, or a pretrained_model folder"
            raise ManipError(text)
        folder = root / inside
        self.evaluation, self.was_chosen_by = _evaluation(root, folder)
        files = ("config", "manip_il", "train_config")
        self.config, self.meta, self.training = (_read(folder / f"{name}.json") for name in files)
        self.type = str(self.config.get("type", "policy"))
        self.robot, self.task = (str(self.meta.get(key) or self.evaluation.get(key) or "") for key in ("robot", "task"))
        self.dataset = str((self.training.get("dataset") or {}).get("repo_id") or "")


def policy_fields(root: Path, place: str) -> tuple[ModelCardData, dict[str, Any]]:
    """Return metadata and fields of the card. place: USER/NAME of the repository.

    Raises `ManipError` for a folder without a policy, and Python's own errors for JSON files with unexpected values.
    """
    policy = Policy(root)
    title = f"{policy.type} for {policy.robot} {policy.task}" if policy.robot else policy.type
    # Options name the robot and the task only if the policy's own folder does not.
    missing = [
        (key, name) for key, name in (("robot", policy.robot), ("task", policy.task)) if not policy.meta.get(key)
    ]
    options = "".join(f" --{key}.type={name}" for key, name in missing if name)
    return _metadata(policy, title), {
        "title": title,
        "is_ours": bool(policy.meta),
        "place": place,
        "rows": list(_rows(root, policy)),
        "options": f"{options} --eval.n_episodes=200",
        "environment": _environment(policy),
        "fingerprint": (policy.meta.get("fingerprint") or {}).items(),
    }


def _metadata(policy: Policy, title: str) -> ModelCardData:
    tags = dict.fromkeys(["robotics", "lerobot", "manip_il", policy.type, policy.robot, policy.task])
    results = None
    if "success_rate" in policy.evaluation:
        rate, name = float(policy.evaluation["success_rate"]), f"{policy.robot} {policy.task}".strip() or "unknown"
        results = [EvalResult("robotics", "manip_il", name, "success_rate", rate, metric_name="success rate")]
    is_on_hub = _REPO_ID.fullmatch(policy.dataset) and not policy.dataset.startswith("local/")
    return ModelCardData(
        license="apache-2.0",
        library_name="lerobot",
        pipeline_tag="robotics",
        tags=[tag for tag in tags if tag],
        model_name=title.replace(" ", "_"),
        datasets=policy.dataset if is_on_hub else None,
        eval_results=results,
    )


def _rows(root: Path, policy: Policy) -> Iterator[tuple[str, object]]:
    meta = policy.meta
    yield "policy", f"`{policy.type}`"
    if policy.robot:
        yield "robot, task", f"`{policy.robot}`, `{policy.task}`"
    yield "sees", ", ".join(f"`{key}`" for key in policy.config.get("input_features") or {}) or "nothing"
    if meta.get("cameras"):
        height, width = meta.get("image_size", (0, 0))
        yield "cameras", f"{', '.join(meta['cameras'])}, {width} x {height} pixels"
    if meta.get("action_meaning"):
        yield "action", f"{meta['action_meaning']}, {meta.get('fps', '?')} a second"
    if policy.dataset:
        yield "learnt from", f"`{policy.dataset}`"
    elif (root / _DATASET / INFO).is_file():
        data = dataset_info(root / _DATASET)
        yield "learnt from", f"{data.episodes:,} episodes, {data.frames:,} frames"
    options = {**(meta.get("options") or {}), **policy.training}
    fit = [text.format(options[key]) for key, text in _FIT.items() if options.get(key) is not None]
    if fit:
        yield "fit", ", ".join(fit)
    yield "success", _success(policy)


def _success(policy: Policy) -> str:
    found = policy.evaluation
    if "success_rate" not in found:
        return "not measured; see below"
    low, high = found.get("interval") or (float("nan"), float("nan"))
    confidence = float(found.get("confidence", 0.95))
    count = f"{found['n_episodes']:,} episodes"
    text = f"**{found['success_rate']:.1%}** [{low:.1%}, {high:.1%}] ({confidence:.0%} interval, {count})"
    return f"{text}, on the seeds that it was chosen on" if policy.was_chosen_by else f"{text}, on unseen seeds"


def _environment(policy: Policy) -> str:
    """Return the options by which LeRobot's evaluator finds our robots; a placeholder for a policy of another robot."""
    if not (policy.meta and policy.robot and policy.task):
        return "--env.type=..."
    task = "".join(word.capitalize() for word in f"{policy.robot}_{policy.task}".split("_"))
    words = [f"--env.discover_packages_path={_PLUGIN}", "--env.type=manip_il", f"--env.task={task}-v0"]
    if policy.meta.get("cameras"):
        height, width = policy.meta.get("image_size", (128, 128))
        has_state = ENVIRONMENT_STATE in (policy.config.get("input_features") or {})
        words += [
            f"--env.observation={'both' if has_state else 'images'}",
            f"--env.cameras={','.join(policy.meta['cameras'])}",
        ]
        words += [f"--env.observation_height={height}", f"--env.observation_width={width}"]
    return " \\\n  ".join([*words, "--eval.n_episodes=50"])


def _evaluation(root: Path, folder: Path) -> tuple[Mapping[str, Any], bool]:
    """Return the nearest `eval.json` beside the weights, up to the folder of their run; else one of its rounds."""
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
    """Return the object in a JSON file; an empty one if the file is missing or damaged."""
    try:
        return checks.read_json(path, "a JSON file beside a policy")
    except ManipError:
        return {}
