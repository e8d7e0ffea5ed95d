"""Names of policy types, observations and action spaces. Imports nothing, so that help is fast."""

ACTION_SPACES = ("joint_target", "joint_delta", "ee_delta")
JOINT_TARGET, JOINT_DELTA, EE_DELTA = ACTION_SPACES
# policies whose network converts actions itself, by default from joint_delta
MLP, CNN = OWN_SPACE = ("mlp", "cnn")
CONVERTED = (*OWN_SPACE, "act", "diffusion", "vqbet")  # policies whose actions may be converted
# policies that load no models by name
PLAIN = ("act", "cnn", "diffusion", "gaussian_actor", "mlp", "tdmpc", "vqbet")
# in addition to the joints: the true poses, pictures, or both
OBSERVATIONS = ("state", "images", "both")
