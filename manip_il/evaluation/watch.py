"""Show running episodes in a window, or write them to a file of Rerun's."""

from pathlib import Path

from manip_il.data import schema
from manip_il.errors import requires
from manip_il.mdp import Transition
from manip_il.sim.env import ManipEnv
from manip_il.sim.task import phases
from manip_il.sim.view import Window
from manip_il.worlds.config import EnvConfig
from manip_il.worlds.table import env_spec

with requires("view", "'manip_il[view]'"):
    import rerun

FRAME = "frame"  # timeline: control steps since the first episode began
_JPEG_QUALITY = 90


class WindowScreen:
    """MuJoCo's viewer for one environment, with its phase and progress.

    Objects can be dragged with the mouse.

    Args:
        env: The environment.

    Raises:
        RenderError: if there is no display.
    """

    def __init__(self, env: ManipEnv):
        self._env, self._phases = env, phases(env.scene.task)
        self._window = Window(env.scene, env.config.control_hz)

    def add(self, step: Transition) -> bool:
        """Show the world after a step, in real time; return False once the window is closed."""
        phase = f"  {self._phases[step.label.phase]}" if step.label else ""
        solved = "  solved" if step.success else ""
        text = (
            f"seed {step.seed}  step {step.step + 1}{phase}  progress"
            f" {100 * self._env.progress:.0f} %{solved}"
        )
        self._window.show(self._env.data, self._env.world.variation, text)
        self._window.pull(self._env.data)
        return self._window.is_open

    def close(self) -> None:
        """Close the window."""
        self._window.close()


def outcome(step: Transition) -> str:
    """Return how an episode ended, given its last step."""
    return (
        f"seed {step.seed}: {'solved' if step.success or step.state.ever else 'not solved'},"
        f" {step.step + 1} steps"
    )


class RerunLog:
    """Steps of episodes, written to a file of Rerun's.

    Args:
        env: The environment.
        output: The file.

    Raises:
        OSError: if the file cannot be written.
    """

    def __init__(self, env: EnvConfig, output: Path):
        # check first: rerun prints lines of its own if it cannot write
        output.open("wb").close()
        self._spec, self._hz = env_spec(env), env.control_hz
        self._frames = 0
        self._stream = rerun.RecordingStream("manip_il")
        self._stream.save(output)
        for name in (schema.STATE, schema.ACTION, schema.EXECUTED_ACTION):
            self._stream.log(name, rerun.SeriesLines(names=self._spec.joint_names), static=True)

    def add(self, step: Transition) -> bool:
        """Log a step; always returns True."""
        stream = self._stream
        stream.set_time("time", duration=self._frames / self._hz)
        stream.set_time(FRAME, sequence=self._frames)
        self._frames += 1
        for camera, picture in step.observation.images.items():
            stream.log(
                schema.IMAGES + camera, rerun.Image(picture).compress(jpeg_quality=_JPEG_QUALITY)
            )
        numbers = {
            schema.STATE: step.observation.state,
            schema.EXECUTED_ACTION: step.executed_action,
            schema.PROGRESS: step.progress,
        }
        if step.label is not None:
            numbers[schema.ACTION] = step.label.action
            stream.log(
                schema.EXPERT_PHASE, rerun.StateChange(state=self._spec.phases[step.label.phase])
            )
        for name, value in numbers.items():
            stream.log(name, rerun.Scalars(value))
        if step.done:
            stream.log("events", rerun.TextLog(outcome(step)))
        return True

    def close(self) -> None:
        """Write what is pending."""
        self._stream.flush()
        self._stream.disconnect()
