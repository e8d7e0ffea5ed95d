"""What a policy sees: the joint state with the true poses, with pictures, or with both."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

from manip_il.data.schema import ACTION, ENVIRONMENT_STATE, IMAGES, STATE
from manip_il.errors import ManipError, UnknownName

if TYPE_CHECKING:  # LeRobot takes seconds to import
    from lerobot.configs import PolicyFeature

OBSERVATIONS = ("state", "images", "both")
_LACKING = {
    STATE: "every policy needs the measured joints",
    ENVIRONMENT_STATE: "choose the observation 'images', or record with `manip-il record`",
    IMAGES: "record with --cameras=front,wrist, add pictures with `manip-il render`, or choose the observation 'state'",
    ACTION: "there is nothing to learn",
}


def policy_features(
    features: Mapping[str, dict[str, Any]], observation: str
) -> tuple[dict[str, PolicyFeature], dict[str, PolicyFeature]]:
    """Return LeRobot's input and output features of a policy, from the `features` of `info.json`.

    observation: `state` is `observation.state` and `observation.environment_state`, `images` is `observation.state`
    and every camera, `both` all three. Pictures, (H, W, 3) in the table, are (3, H, W) for a policy. Raises
    `UnknownName` for another choice, `ManipError` for what the table lacks.
    """
    from lerobot.configs import PolicyFeature
    from lerobot.utils.feature_utils import dataset_to_policy_features

    if observation not in OBSERVATIONS:
        raise UnknownName("observation", observation, OBSERVATIONS)
    cameras = [key for key in features if key.startswith(IMAGES)]
    wanted = [STATE]
    if observation != "images":
        wanted.append(ENVIRONMENT_STATE)
    if observation != "state":
        wanted += cameras or [IMAGES]
    for key in (*wanted, ACTION):
        if key not in features:
            what = "pictures" if key == IMAGES else key
            raise ManipError(f"observation {observation!r}: the dataset has no {what}; {_LACKING[key]}")
    chosen = dataset_to_policy_features({key: features[key] for key in (*wanted, ACTION)})
    typed = {key: PolicyFeature(feature.type, tuple(feature.shape)) for key, feature in chosen.items()}
    return {key: typed[key] for key in wanted}, {ACTION: typed[ACTION]}


def observation_of(input_features: Iterable[str]) -> str:
    """Return the choice that a policy was trained with, from the `input_features` of its config.json."""
    keys = set(input_features)
    pictures = any(key.startswith(IMAGES) for key in keys)
    if not pictures:
        return "state"
    return "both" if ENVIRONMENT_STATE in keys else "images"


def recorded_look(provenance: Mapping[str, Any], fingerprint: Mapping[str, Any]) -> dict[str, Any] | None:
    """Return the light in which a dataset's pictures were made, as arguments of `sim.look.Look`; {} is the default.

    None where that is not known: another program's dataset, or one without pictures.
    """
    if "cameras_sha256" not in fingerprint:
        return None
    rendered = provenance.get("rendered", {}).get("cameras", {})  # `record` has the default light alone
    return dict(rendered.get("look", {}))
