"""The options of a fit by LeRobot's names, and the names of policies and of their options.

Names are read from the text of LeRobot's and our configuration files, so that a mistyped one is answered at once:
importing the configurations themselves takes seconds.
"""

from __future__ import annotations

import ast
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

from manip_il.checks import read_json
from manip_il.errors import UnknownName, UsageError
from manip_il.option import option

JOINT_TARGET, JOINT_DELTA, EE_DELTA = ACTION_SPACES = ("joint_target", "joint_delta", "ee_delta")
OWN_SPACE = ("mlp", "cnn")  # policies that know their action space: joint_delta unless told otherwise
CONVERTED = (*OWN_SPACE, "act", "diffusion", "vqbet")  # policies whose actions may be converted
MLP = "mlp"  # the one policy with a loop of its own
MLP_LR = 2e-3
# Where a policy's configuration is kept with what was meant for one machine or one command.
NOT_OURS = ("push_to_hub", "repo_id", "private", "pretrained_path", "pretrained_revision", "use_peft")
_AT_LEAST_1 = ("steps", "batch_size", "threads", "processes", "log_freq", "save_freq")
_AT_LEAST_0 = ("num_workers", "image_cache_gb")
_REGISTERED = re.compile(r"""@PreTrainedConfig\.register_subclass\(\s*["'](\w+)["']""")
_BASE = "PreTrainedConfig"
_FEW = 12  # names that one line of an error may list


class Defaults(NamedTuple):
    """Gradient steps, samples in the batch of one, steps from one checkpoint to the next."""

    steps: int
    batch_size: int
    save_freq: int


LEROBOT = Defaults(100_000, 8, 20_000)
DEFAULTS = {MLP: Defaults(3_000, 512, 1_000), "cnn": Defaults(15_000, 32, 1_000)}  # where they are not LeRobot's


def _by_default(name: str) -> str:
    """Return what a number is where it is not given, by the kind of the policy."""
    own = ", ".join(f"{getattr(numbers, name):,} for {kind}" for kind, numbers in DEFAULTS.items())
    return f"by default {own}, else {getattr(LEROBOT, name):,}"


@dataclass(frozen=True)
class MLPOptions:
    """The options of the mlp that change most; `MLPConfig` has them all."""

    loss: str = option("l1", "l1, mse, gaussian, mixture or categorical")
    width: int = option(256, "units per layer")
    depth: int = option(3, "hidden layers")


@dataclass(frozen=True)
class FitConfig:
    """Options of a fit; None is the default of the policy's kind.

    policy: `type` or `path`, and what that policy knows (`loss`, `width`, `chunk_size`, ...). action_space: see
    `manip_il.learn.action_spaces`; by default that of a checkpoint to start from, too. observation: `state`, `images`
    or `both`. threads: a second one is up to 1.8 times as fast where a core is free, and tens of times slower
    where none is. trust: whether models that the policy or its checkpoint names may be loaded. seed: of weights and
    batches. init_from: a `pretrained_model` folder whose weights to start from.

    Raises `UsageError` for a number out of range or an option that is not for the mlp, `UnknownName` for a policy or an
    option of it that is not there.
    """

    policy: Mapping[str, Any] = option(
        dict,
        "an option of the policy by its name: type (mlp, cnn or one of LeRobot's), path of a policy to start from, or "
        "one that --policy.type=TYPE --help lists",
    )
    action_space: str | None = option(
        None, "what is learnt, out of the same dataset; by default joint_delta by mlp and cnn, else joint_target"
    )
    observation: str | None = option(
        None, "what the policy observes besides its joints; by default images if the policy is cnn, else state"
    )
    steps: int | None = option(None, f"gradient steps; {_by_default('steps')}")
    batch_size: int | None = option(None, f"frames per step; {_by_default('batch_size')}")
    lr: float | None = option(None, f"peak learning rate; by default {MLP_LR} for mlp, else the policy's own")
    optimizer: Mapping[str, Any] = option(
        dict, "an option of an optimiser in place of the policy's own: type (adamw), weight_decay, ..."
    )
    scheduler: Mapping[str, Any] = option(
        dict, "an option of a schedule of the learning rate in place of the policy's own: type, ..."
    )
    eval_split: float = option(0.05, "share of the episodes held out for val_loss")
    image_augment: bool | None = option(
        None, "random crops and colour jitter of pictures while training; by default for all but cnn"
    )
    image_cache_gb: float = option(
        20.0, "most that decoded pictures take in the temporary folder [GB]; beyond it each step decodes its own"
    )
    num_workers: int = option(4, "processes that decode pictures beyond image_cache_gb")
    threads: int = option(1, "PyTorch threads; more help only on free cores")
    processes: int = option(1, "processes that share each batch of a policy other than mlp; one a free core")
    save_freq: int | None = option(None, f"steps between checkpoints; {_by_default('save_freq')}")
    log_freq: int = option(200, "steps between metrics")
    tensorboard: bool = option(False, "curves for TensorBoard, in OUTPUT_DIR/tensorboard")
    wandb: Mapping[str, Any] = option(dict, "an option of Weights & Biases: enable, project, mode, ...")
    trust: bool = False
    seed: int = 0
    init_from: Path | None = None

    def __post_init__(self) -> None:
        for name, least in (*((name, 1) for name in _AT_LEAST_1), *((name, 0) for name in _AT_LEAST_0)):
            value = getattr(self, name)
            if value is not None and value < least:
                raise UsageError(f"{name} is {value}; expected at least {least}")
        if not 0.0 <= self.eval_split < 1.0:
            raise UsageError(f"dataset.eval_split is {self.eval_split}; expected at least 0 and less than 1")
        if self.lr is not None and not 0.0 < self.lr < math.inf:
            raise UsageError(f"lr is {self.lr}; expected more than 0")
        check_names(self.policy)
        if self.processes > 1 and self.is_mlp:
            raise UsageError(f"processes is {self.processes}; the mlp is fitted by one")
        if self.samples_per_step % self.processes:
            raise UsageError(
                f"batch_size is {self.samples_per_step}; expected a multiple of processes ({self.processes})"
            )
        if self.action_space is not None and self.action_space not in ACTION_SPACES:
            raise UnknownName("action space", self.action_space, ACTION_SPACES)
        if "path" not in self.policy:
            check_convertible(str(self.policy.get("type", MLP)), self.action_space or JOINT_TARGET)
        if self.is_mlp and self.observation not in (None, "state"):
            raise UsageError(
                f"--policy.type=mlp does not take images, so not --observation={self.observation}; use cnn"
            )
        for name in ("optimizer", "scheduler"):
            if self.is_mlp and getattr(self, name):
                raise UsageError(f"--{name} is not for --policy.type=mlp, which has its own loop and schedule")

    @property
    def is_mlp(self) -> bool:
        """Whether the policy is fitted by `manip_il.learn.train`."""
        return "path" not in self.policy and self.policy.get("type", MLP) == MLP

    @property
    def takes_images(self) -> bool:
        """Whether pictures are among the policy's inputs. Raises `ManipError` for a `path` without a policy."""
        if self.is_mlp or self.observation is not None:
            return not self.is_mlp and self.observation != "state"
        path = self.policy.get("path")
        kind = read_json(Path(path) / "config.json", "a policy's").get("type") if path else self.policy["type"]
        return kind == "cnn"

    @property
    def defaults(self) -> Defaults:
        """Numbers that hold where none are given; LeRobot's for a policy to start from."""
        return LEROBOT if "path" in self.policy else DEFAULTS.get(self.policy.get("type", MLP), LEROBOT)

    @property
    def augments(self) -> bool:
        """Whether pictures are changed by chance; cropped ones do not show the cnn where things are."""
        return self.policy.get("type") != "cnn" if self.image_augment is None else self.image_augment

    @property
    def total_steps(self) -> int:
        """Gradient steps."""
        return self.steps or self.defaults.steps

    @property
    def samples_per_step(self) -> int:
        """Samples in the batch of a step."""
        return self.batch_size or self.defaults.batch_size

    @property
    def steps_per_checkpoint(self) -> int:
        """Steps from one checkpoint to the next."""
        return self.save_freq or self.defaults.save_freq

    @property
    def peak_lr(self) -> float | None:
        """Peak learning rate; None for that of the optimiser's preset."""
        return MLP_LR if self.lr is None and self.is_mlp else self.lr


def check_weights(roots: Sequence[Path], weights: Sequence[float]) -> None:
    """Raise `UsageError` for no dataset, for one that is given twice, and for weights that do not fit them."""
    if not roots:
        raise UsageError("--dataset.root names no dataset; expected at least one folder")
    seen: dict[Path, Path] = {}
    for root in roots:
        if (real := root.resolve()) in seen:
            raise UsageError(f"--dataset.root names {seen[real]} and {root}, one dataset; use --dataset.weights")
        seen[real] = root
    if weights and len(weights) != len(roots):
        raise UsageError(f"--dataset.weights has {len(weights)} numbers, --dataset.root {len(roots)} datasets")
    for root, weight in zip(roots, weights, strict=False):
        if not 0 < weight < math.inf:
            raise UsageError(f"--dataset.weights is {weight:g} for {root}; expected more than 0")


@cache
def policy_files() -> Mapping[str, Path]:
    """Return `--policy.type` -> file of its configuration, for every policy of LeRobot's and of this project."""
    roots = (_lerobot() / "policies", Path(__file__).parent)
    files = [file for root in roots for file in root.glob("*/configuration_*.py")]
    return {kind: file for file in sorted(files) for kind in _REGISTERED.findall(file.read_text(encoding="utf-8"))}


def policy_options(kind: str) -> tuple[str, ...]:
    """Return the names of a policy type's options, sorted; none where its configuration is of another form."""
    base = _lerobot() / "configs" / "policies.py"
    files = (base, policy_files()[MLP], policy_files()[kind])  # the cnn's options are the mlp's, and some
    classes = {name: one for file in files for name, one in _classes(file).items()}
    name = next((name for name, one in classes.items() if kind in _registered(one)), "")
    names: set[str] = set()
    while name in classes:
        names |= set(_fields(classes[name]))
        if name == _BASE:
            return tuple(sorted(names - {*NOT_OURS}))
        bases = [base.id for base in classes[name].bases if isinstance(base, ast.Name)]
        name = bases[0] if len(bases) == 1 else ""
    return ()


def check_convertible(kind: str, space: str) -> None:
    """Raise `UsageError` for a policy type whose processors cannot carry an action space."""
    if space != JOINT_TARGET and kind not in CONVERTED:
        raise UsageError(
            f"action_space is {space!r}, which LeRobot's processors of {kind!r} cannot carry; expected {JOINT_TARGET}, "
            f"or --policy.type={', '.join(CONVERTED[:-1])} or {CONVERTED[-1]}"
        )


def check_names(settings: Mapping[str, Any]) -> None:
    """Raise `UnknownName` for a type or an option of `--policy.*` that is not there; a `path` is not read."""
    if "path" in settings:
        return
    kind = settings.get("type", MLP)
    if not isinstance(kind, str) or kind not in policy_files():
        raise UnknownName("policy", str(kind), policy_files())
    known = policy_options(kind)
    for name in settings:
        if known and name not in (*known, "type"):
            hint = f"manip-il train --policy.type={kind} --help lists all" if len(known) > _FEW else ""
            raise UnknownName(f"option of --policy.type={kind}:", name, known, hint)


def _lerobot() -> Path:
    """The folder of LeRobot's package, found without importing it."""
    spec = find_spec("lerobot")
    assert spec is not None
    assert spec.submodule_search_locations
    return Path(spec.submodule_search_locations[0])


@cache
def _classes(file: Path) -> dict[str, ast.ClassDef]:
    tree = ast.parse(file.read_text(encoding="utf-8"))
    return {node.name: node for node in tree.body if isinstance(node, ast.ClassDef)}


def _registered(node: ast.ClassDef) -> list[str]:
    return [name for one in node.decorator_list for name in _REGISTERED.findall(f"@{ast.unparse(one)}")]


def _fields(node: ast.ClassDef) -> Iterator[str]:
    """Annotated names in a dataclass's body that are options."""
    for line in node.body:
        if isinstance(line, ast.AnnAssign) and isinstance(line.target, ast.Name):
            text = ast.unparse(line)
            if "ClassVar[" not in text and "init=False" not in text:
                yield line.target.id
