"""Cards for the Hub: `README.md` of a dataset or policy, and a dataset's picture, made from its folder.

The texts are the templates `card_dataset.md.jinja`, filled from the module of that name, and `card_policy.md.jinja`.
No card holds an absolute path, a token or a date: the same folder gives the same bytes.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any, cast

from huggingface_hub import DatasetCard, EvalResult, ModelCard, ModelCardData

from manip_il import checks
from manip_il.checks import parse_yaml
from manip_il.data.dataset import Dataset
from manip_il.data.lerobot_layout import INFO
from manip_il.data.schema import ENVIRONMENT_STATE
from manip_il.errors import ManipError
from manip_il.store.card_dataset import dataset_fields, draw_picture
from manip_il.store.errors import redact
from manip_il.store.manifest import CARD, CONFIG, Kind, journals_of, policy_folder

PICTURE = "assets/episodes.png"
_MADE_BY = "| made by | manip_il"  # a row of every card of ours
_REPOSITORY = "USER/NAME"  # in the commands of a card that is not for a Hub
_COMMANDS = {
    **{"RecordOptions": "record", "TrainOptions": "train", "DaggerOptions": "dagger"},
    **{"GailOptions": "gail", "AirlOptions": "airl", "PpoOptions": "ppo"},
}
_HEADER = re.compile(r"# manip-il \S+: resolved options \((\w+)\)")
_NOT_SHOWN = (  # options that are places, or concern one machine
    *("root", "output_dir", "repo_id", "config_path", "resume", "overwrite", "engine", "device", "workers", "threads"),
    *("num_workers", "memory", "image_cache_gb", "log_freq", "save_freq", "tensorboard"),
)
_SECRET = re.compile(r"token|secret|password|passwd|credential|api_?key", re.IGNORECASE)
_LARGEST_CONFIG = 100_000  # [bytes]

_PLACES = tuple(
    f"{folder}{CONFIG}" for folder in ("", "pretrained_model/", "*/pretrained_model/", "*/*/pretrained_model/")
)
_LEVELS = re.compile(r"pretrained_model|policy|best|last|checkpoints|\d+")  # folders of one run, above its weights
_PLUGIN = "manip_il.lerobot_plugin"  # our robots and policies in LeRobot's own commands
_DATASET = "dataset"  # folder of a DAgger run: what its policy was fitted to
_REPO_ID = re.compile(r"[\w.-]+/[\w.-]+")
_FIT = {"steps": "{} steps", "batch_size": "batches of {}", "lr": "learning rate {}", "seed": "seed {}"}


def card_for(root: Path, kind: Kind, url: str) -> dict[str, bytes]:
    """Return path in the repository -> content. url: of the repository, for the commands that the card shows.

    A `README.md` of another origin is kept: then the result holds none. Raises `ManipError` for a folder that cannot be
    read.
    """
    card = root / CARD
    is_kept = card.is_file() and _MADE_BY not in card.read_text(encoding="utf-8", errors="replace")
    found = re.fullmatch(r"hf://(?:datasets/|models/)?([^@]+)(?:@.*)?", url)
    place = found[1] if found else _REPOSITORY
    if kind == "policy":
        return {} if is_kept else {CARD: _policy_card(root, place)}
    picture = draw_picture(root)
    files = {PICTURE: picture} if picture else {}
    if not is_kept:
        data, fields = dataset_fields(root, place)
        above = root.absolute().parent / "config.yaml"
        fields["command"] = command(journals_of(root) / "config.yaml") or command(above)
        fields["picture"] = PICTURE if picture else None
        files[CARD] = _render(DatasetCard, "card_dataset", data, fields)
    return files


def _policy_card(root: Path, place: str) -> bytes:
    try:
        return _render(ModelCard, "card_policy", *policy_fields(root, place))
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise ManipError(
            f"{root}: its card cannot be written, as a JSON file beside the policy holds unexpected values "
            f"({type(error).__name__}: {checks.shorten(str(error))}); restore the file"
        ) from error


def _render(card: type[DatasetCard | ModelCard], template: str, data: Any, fields: dict[str, Any]) -> bytes:
    """Fill a template. Every value of a table becomes one cell, without a secret."""
    values = {**fields, "version": version("manip_il")}
    for name in ("rows", "fingerprint"):
        values[name] = [(_cell(label), _cell(value)) for label, value in fields[name]]
    path = Path(__file__).with_name(f"{template}.md.jinja")
    made = card.from_template(data, template_path=str(path), **values)
    return f"{made}\n".encode()


def _cell(value: object) -> str:
    return redact(" ".join(str(value).split())).replace("|", "\\|")


def command(config: Path) -> str | None:
    """Return the `manip-il` command of a `config.yaml` of ours; None without one.

    Leaves out folders, options of one machine, and anything that could be a secret.
    """
    if not config.is_file() or config.stat().st_size > _LARGEST_CONFIG:
        return None
    text = config.read_text(encoding="utf-8", errors="replace")
    header = _HEADER.match(text)
    word = _COMMANDS.get(header[1]) if header else None
    if word is None:
        return None
    try:
        tree = parse_yaml(text)
    except ValueError:
        return None
    words = [f"--{name}={value}" for name, value in _leaves(tree) if _is_shown(name, value)]
    return redact(f"manip-il {word} \\\n  " + " \\\n  ".join(words))


def _leaves(tree: object, prefix: str = "") -> list[tuple[str, str]]:
    if isinstance(tree, dict):
        named = cast("Mapping[str, object]", tree)
        return [
            leaf for key, value in named.items() for leaf in _leaves(value, f"{prefix}.{key}" if prefix else str(key))
        ]
    if isinstance(tree, list):
        items = cast("Sequence[object]", tree)
        return [(prefix, ",".join(map(str, items)))] if items else []
    if isinstance(tree, bool):
        return [(prefix, str(tree).lower())]
    return [] if tree is None else [(prefix, str(tree))]


def _is_shown(name: str, value: str) -> bool:
    is_plain = re.fullmatch(r"[\w.,:+@=-]+", value)  # no path, nothing that a shell would read
    return bool(is_plain) and name.split(".")[-1] not in _NOT_SHOWN and not _SECRET.search(name)


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
        "folder": place.rpartition("/")[2] if place != _REPOSITORY else "policy",
        "command": command(root / "config.yaml"),
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
        data = Dataset.open(root / _DATASET).summary
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
    folder = folder.resolve()
    for place in (folder, *folder.parents):
        if found := _evaluations((place / "eval.json", *sorted(place.glob("eval*/eval.json")))):
            return max(found, key=lambda one: one["n_episodes"]), place.name.startswith("round_")
        if not _LEVELS.fullmatch(place.name):
            break
    rounds = _evaluations(sorted(root.glob("round_*/eval.json")))
    return (max(rounds, key=lambda one: one["success_rate"]), True) if rounds else ({}, False)


def _evaluations(paths: Iterable[Path]) -> list[dict[str, Any]]:
    needed = ("success_rate", "n_episodes")
    return [one for one in map(_read, paths) if all(isinstance(one.get(key), int | float) for key in needed)]


def _read(path: Path) -> dict[str, Any]:
    """Return the object in a JSON file; an empty one if the file is missing or damaged."""
    try:
        return checks.read_json(path, "a JSON file beside a policy")
    except ManipError:
        return {}
