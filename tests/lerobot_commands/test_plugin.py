"""The distribution `lerobot_env_manip_il`, as `pip install` leaves it: metadata and one module."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from manip_il.learn.checkpoint import Origin
from manip_il.worlds.table import env_spec, make_config

from ..learn.tiny_policies import write_checkpoint

pytestmark = pytest.mark.slow
PLUGIN = Path(__file__).parents[2] / "plugin"
INSTALL = "from setuptools.build_meta import *; prepare_metadata_for_build_wheel('.')"
RUN = """import sys
sys.path.insert(0, {folder!r})
sys.argv = {words!r}
from lerobot.scripts.lerobot_eval import main
main()"""


def test_an_unmodified_lerobot_eval_knows_our_environment_and_policy(warm_lerobot, tmp_path):
    installed = tmp_path / "installed"
    shutil.copytree(PLUGIN, installed, ignore=shutil.ignore_patterns("*.egg-info", "build"))
    subprocess.run([sys.executable, "-c", INSTALL], cwd=installed, check=True, capture_output=True)
    spec = env_spec(make_config("panda", "reach"))
    policy = write_checkpoint(tmp_path / "policy", "mlp", spec, "state", origin=Origin.of(spec))
    words = [
        "lerobot-eval",
        f"--policy.path={policy}",
        "--policy.device=cpu",
        "--env.type=manip_il",
        "--eval.use_async_envs=false",
    ]
    words += ["--env.task=PandaReach-v0", "--env.episode_length=5", "--env.render_mode=none"]
    words += ["--eval.n_episodes=1", "--eval.batch_size=1", f"--output_dir={tmp_path / 'eval'}"]
    done = warm_lerobot.run("python", "-c", RUN.format(folder=str(installed), words=words))
    assert done.returncode == 0, (done.stdout + done.stderr)[-4000:]
    assert (tmp_path / "eval" / "eval_info.json").is_file()
