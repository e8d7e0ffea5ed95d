"""LeRobot's pre- and post-processors for the `cnn` policy: the mlp's, by the name that LeRobot looks for."""

from manip_il.learn.mlp.processor_mlp import make_mlp_pre_post_processors as make_cnn_pre_post_processors

__all__ = ["make_cnn_pre_post_processors"]
