"""Names of kinds of policies, of what they see and of what they learn. Help reads them, so nothing is imported here."""

JOINT_TARGET, JOINT_DELTA, EE_DELTA = ACTION_SPACES = ("joint_target", "joint_delta", "ee_delta")
MLP, CNN = OWN_SPACE = ("mlp", "cnn")  # policies that know their action space: joint_delta unless told otherwise
CONVERTED = (*OWN_SPACE, "act", "diffusion", "vqbet")  # policies whose actions may be converted
PLAIN = ("act", "cnn", "diffusion", "gaussian_actor", "mlp", "tdmpc", "vqbet")  # policies that load nothing by name
OBSERVATIONS = ("state", "images", "both")  # besides the joints: the true poses, pictures, or both
