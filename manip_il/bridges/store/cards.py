"""Cards for the Hub: `README.md` of a dataset or policy, from `card.md.jinja`.

Cards hold no absolute path, token or date, so that the same folder gives the same bytes. A card of another program's
dataset or policy claims neither our licence nor our authorship.
"""

from __future__ import annotations

import shlex
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jinja2
import numpy as np

from manip_il import checks
from manip_il.bridges.store.errors import redact
from manip_il.bridges.store.manifest import CARD, CONFIG, Kind, policy_folder
from manip_il.data import schema as s
from manip_il.data.dataset import Dataset
from manip_il.data.fingerprint import policy_sha256
from manip_il.data.lerobot_layout import INFO
from manip_il.errors import ManipError
from manip_il.sim.conditions import NOMINAL
from manip_il.worlds.table import world_of

_OURS = b"<!-- written by manip-il push -->"  # a card with this line is ours and is replaced


def write_cards(root: Path, kind: Kind, place: str, folder: Path) -> dict[str, Path]:
    """Write a card into `folder`; return it by its path in the repository. place: USER/NAME.

    A `README.md` that is not ours is kept, and the result is empty. Raises `ManipError` if the folder cannot be read.
    """
    made, dataset = dict[str, Path](), Dataset.open(root) if kind == "dataset" else None
    if not (root / CARD).is_file() or _OURS in checks.read_bytes(root / CARD, "a card"):
        environment = jinja2.Environment(finalize=_shown)
        environment.filters["word"] = lambda value: shlex.quote(_shown(str(value)))
        environment.filters["cell"] = lambda value: " ".join(str(value).split()).replace("|", "\\|")
        template = environment.from_string(Path(__file__).with_name("card.md.jinja").read_text(encoding="utf-8"))
        facts: dict[str, Any] = {"place": place, "version": version("manip_il")}
        try:
            if dataset:
                seeds = np.unique(dataset.columns([s.SEED])[s.SEED]).tolist() if s.SEED in dataset.features else []
                facts |= {"dataset": dataset, "is_ours": bool(dataset.own), "seeds": seeds}
            else:
                facts |= policy_facts(root)
            made[CARD] = folder / CARD
            made[CARD].write_text(f"{template.render(facts)}\n", encoding="utf-8")
        except (AttributeError, LookupError, TypeError, ValueError, jinja2.TemplateError) as error:
            text = f"{type(error).__name__}: {checks.one_line(error)}"
            raise ManipError(f"{root}: a JSON file in it holds unexpected values ({text}); restore the file") from error
    return made


def _shown(value: Any) -> Any:
    """Return a value as a card shows it: text on one line, without secrets."""
    return redact(" ".join(value.splitlines())) if isinstance(value, str) else value


def policy_facts(root: Path) -> dict[str, Any]:
    """Return the template's values for a policy or its run. Raises `ManipError` if there is no policy."""
    inside = policy_folder(path.relative_to(root).as_posix() for path in root.rglob(CONFIG))
    if inside is None:
        raise ManipError(f"no policy in {root}; push a run that has saved a checkpoint, or a pretrained_model folder")
    found = {name: root / inside / f"{name}.json" for name in ("config", "manip_il", "train_config")}
    facts = {name: checks.read_json(path, "JSON") if path.is_file() else {} for name, path in found.items()}
    own = policy_sha256(root / inside)
    evaluations = [  # of this policy, undisturbed; `is_test`: false if the policy was chosen by this evaluation
        {**one, "is_test": not path.parent.name.startswith("round_") and path.parent.parent.name != "validation"}
        for path in root.rglob("eval.json")
        if ((one := checks.read_json(path, "JSON")).get("policy_sha256") or own) == own
        and one.get("policy") != "expert"
        and one.get("settings", {}).get("suite", NOMINAL.name) == NOMINAL.name
    ]
    order = ("is_test", "n_episodes", "success_rate")
    facts["evaluation"] = max(evaluations, key=lambda one: [one[key] for key in order], default={})
    fitted_to = Dataset.open(root / "dataset").info if (root / "dataset" / INFO).is_file() else None
    robot, task = (facts["manip_il"].get(name) or "" for name in ("robot", "task"))
    words = world_of(robot).lerobot_words(robot, task)
    return {
        **facts,
        "is_ours": bool(facts["manip_il"]),
        "lerobot_words": words,
        "fitted_to": fitted_to,
    }
