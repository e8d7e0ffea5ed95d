"""A compiled scene and its present physics, which tasks and the expert read by name.

Lengths in [m], angles in [rad], all in the world's frame: z = 0 is the table's top, x points away
from the robot.
"""

import copy
import math
from collections.abc import Callable, Mapping
from functools import cached_property
from typing import Any, NamedTuple, NoReturn

import mujoco
import numpy as np

from manip_il.errors import ManipError, MismatchError
from manip_il.mdp import F64, I64
from manip_il.robots.geometry import angle_across, angle_ahead, angle_from_down, off_yaw, yaw_ahead
from manip_il.robots.reach import Reach, reach_of
from manip_il.sim import variation as variations
from manip_il.sim.rests import Hull
from manip_il.sim.scene import STATE_KIND, Scene
from manip_il.sim.servo import set_joints

# heights and distance at which a hand may hit a neighbour of an object [m]
_BESIDE, _NEAR = (-0.02, 0.07), 0.08
_MOST_TURNS = 4  # symmetric turns tried in each direction
_AT_REST = 0.03, 0.5  # speeds below which an object is at rest [m/s], [rad/s]
GOAL = "goal"  # the mocap body that marks the goal


class Pose(NamedTuple):
    """Position (3,) [m] and rotation matrix (3, 3) of a body or coordinate frame in the world."""

    position: F64
    rotation: F64


class World:
    """One scene's physics, and what can be read from it by name.

    Poses need up-to-date kinematics (`update`).

    Attributes:
        scene: The scene.
        robot: Its robot.
        gripper: Its gripper.
        variation: How the world differs from the compiled model, (v,).
        model: The scene's shared model, or this world's own copy; replaced as the variation
            changes.
        data: The model's data, replaced with it.
        ee: The frame between the fingertips, z out of the hand, y along the fingers' motion.
    """

    def __init__(self, scene: Scene):
        self.scene = scene
        self.robot = scene.robot
        self.gripper = scene.gripper
        self.variation = scene.nominal
        # servos change their model in every step
        model = copy.copy(scene.model) if scene.servos else scene.model
        self._plain = model, mujoco.MjData(model)
        self._own: tuple[mujoco.MjModel, mujoco.MjData] | None = None
        self._cache: dict[Any, Any] = {}  # cleared when the world moves
        self._use(*self._plain)

    def _use(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        self.model, self.data = model, data
        at, self._poses = self.scene.ee_site, dict[str, Pose]()
        # a view that follows the world
        self.ee = Pose(data.site_xpos[at], data.site_xmat[at].reshape(3, 3))

    def __reduce__(self) -> NoReturn:
        raise ManipError(
            "an environment cannot be copied or pickled; make a new one and restore get_state()"
            " there"
        )

    # Physics

    def vary(self, variation: F64) -> None:
        """Apply the physics of a variation to the model.

        Args:
            variation: The variation, (v,).
        """
        if variation.tobytes() == self.variation.tobytes():
            return
        self._cache.clear()
        self.variation = variation.copy()
        if variations.same_physics(variation, self.scene.nominal):
            self._use(*self._plain)
            return
        if self._own is None:
            model = copy.copy(self.scene.model)  # with its own masses and sizes
            self._own = model, mujoco.MjData(model)
        self._use(*self._own)
        variations.apply(
            self.model, self.scene.model, self.scene.objects, self.scene.arm_ctrl, variation
        )
        if self.scene.servos:  # what follows must not depend on the last episode's
            set_joints(self.model, self.scene.servos.dof, self.scene.servos.ranges[0])
        mujoco.mj_setConst(self.model, self.data)  # updates what depends on masses

    def physics(self) -> F64:
        """Return MuJoCo's integration state, (p,)."""
        physics = np.empty(self.scene.state_size)
        mujoco.mj_getState(self.model, self.data, physics, STATE_KIND)
        return physics

    def restore(self, physics: F64, variation: F64) -> None:
        """Restore a state, bit for bit.

        Args:
            physics: MuJoCo's integration state, (p,), as `physics` returned it.
            variation: The variation, (v,).

        Raises:
            MismatchError: If the state is one of another scene.
        """
        given = len(physics), len(variation)
        if given != (sizes := (self.scene.state_size, len(self.scene.nominal))):
            raise MismatchError("size of a state", "it", given, self.scene.name, sizes)
        self.vary(variation)
        mujoco.mj_setState(self.model, self.data, physics, STATE_KIND)
        if self.scene.servos:
            self.scene.servos.apply(self.model, self.data)
        self.update()

    def update(self) -> None:
        """Compute poses from qpos and mocap poses after these have changed."""
        self._cache.clear()
        mujoco.mj_kinematics(self.model, self.data)

    def place(self, name: str, position: F64, quaternion: F64) -> None:
        """Place an object (at rest) or a mocap body. Call `update` next.

        Args:
            name: Name of the object or body.
            position: Its position in the world, (3,) [m].
            quaternion: Its rotation in the world, wxyz, (4,).

        Raises:
            KeyError: If there is no body of this name.
            ManipError: If it is neither an object nor a mocap body.
        """
        if name in self.scene.objects:
            placed = self.scene.objects[name]
            self.data.qpos[placed.q : placed.q + 7] = [*position, *quaternion]
            self.data.qvel[placed.v : placed.v + 6] = 0.0
            return
        mocap = int(self.scene.model.body(name).mocapid[0])
        if mocap < 0:
            raise ManipError(f"{name!r} is neither an object nor a mocap body; it cannot be placed")
        self.data.mocap_pos[mocap], self.data.mocap_quat[mocap] = position, quaternion

    def hold(self) -> None:
        """Make the current joint positions the goals of the servos, if there are any."""
        if self.scene.servos:
            self.scene.servos.hold(self.data)

    # Readings

    def remember[T](self, key: Any, compute: Callable[[], T]) -> T:
        """Return the result of `compute`, cached until the world changes."""
        if key not in self._cache:
            self._cache[key] = compute()
        return self._cache[key]

    def pose(self, name: str) -> Pose:
        """Return the pose of a body, as views that follow the world.

        Args:
            name: Name of the body.

        Raises:
            KeyError: If there is no body of this name.
        """
        pose = self._poses.get(name)
        if pose is None:
            body = self.scene.model.body(name).id
            pose = self._poses[name] = Pose(
                self.data.xpos[body], self.data.xmat[body].reshape(3, 3)
            )
        return pose

    def at(self, name: str) -> F64:
        """Return the position of a body, (3,) [m], as a view that follows the world."""
        return self.pose(name).position

    @property
    def goal(self) -> F64:
        """Position of the goal marker, (3,) [m]."""
        return self.at(GOAL)

    @property
    def measured(self) -> F64:
        """Joint positions and gripper opening in the units of the robot's actions, (n,)."""
        return self.scene.actions.join(self.data.qpos[self.scene.arm_q], self.opening)

    def lead(self, way: F64) -> F64 | float:
        """Return how far servos must aim beyond a way (arm,) to go it [rad], (arm,); 0 if ideal."""
        servos, count = self.scene.servos, len(way)
        if servos is None:
            return 0.0
        return servos.lead(self.model, self.data, np.append(way, 0.0))[:count]

    @property
    def opening(self) -> float:
        """Opening between the gripper's pads [m]."""
        return self.remember("opening", lambda: self.gripper.opening(self.data.qpos))

    def ahead(self, position: F64) -> float:
        """Return the world yaw [rad] that counts as zero for a hand at a position (3,) [m]."""
        return yaw_ahead(self.robot, self.data.xanchor[self.scene.shoulder], position)

    def turns(self, yaw: float, alike: float, position: F64) -> list[float]:
        """Return the hand's yaws, relative to `ahead`, that suit a grasp at a position.

        Args:
            yaw: A yaw of the hand in the world that suits the grasp [rad].
            alike: Turn after which the grasp looks the same [rad].
            position: Position of the hand, (3,) [m].

        Returns:
            The yaws [rad] in the arm's range that are equivalent to `yaw`; if there are none, or if
            the hand turns without limits, only the one nearest to `ahead`.
        """
        low, high = self.scene.yaws
        off = math.remainder(yaw - self.ahead(position), alike)
        most = _MOST_TURNS if math.isfinite(low) else 0
        ways = [off + turn * alike for turn in range(-most, most + 1)]
        return [way for way in ways if low <= way <= high] or [off]

    def turned(self, position: F64) -> float:
        """Return the hand's yaw [rad] relative to `ahead` at a position (3,) [m]."""
        low, high = self.scene.yaws
        middle = (low + high) / 2 if math.isfinite(low) else 0.0
        return middle + math.remainder(self.hand_yaw - self.ahead(position) - middle, 2 * math.pi)

    @property
    def hand_yaw(self) -> float:
        """Yaw of the hand [rad]."""
        hand = self.ee.rotation
        return angle_across(hand) if self.robot.leans else angle_ahead(hand)

    def off_down(self, yaw: float) -> float:
        """Return the angle [rad] between the hand and `hand_down(yaw)`.

        For an arm that leans, in yaw only.
        """
        hand = self.ee.rotation
        return off_yaw(hand, yaw) if self.robot.leans else angle_from_down(hand, yaw)

    def extents(self, name: str) -> tuple[float, ...]:
        """Return an object's lengths along its own x, y and z [m].

        For a mesh, those of a box centred on its origin.
        """
        hull, geom = self.hull(name), self.scene.objects[name].geom
        if hull is not None:
            return hull.extents
        return self.remember(
            ("extents", name), lambda: tuple((2 * self.model.geom_aabb[geom, 3:]).tolist())
        )

    def kind(self, name: str) -> int:
        """Return MuJoCo's geom type of an object."""
        return int(self.model.geom_type[self.scene.objects[name].geom])

    def hull(self, name: str) -> Hull | None:
        """Return the hull of an object that is a mesh; None for any other."""
        return self.scene.hulls.get(name)

    def at_rest(self, name: str) -> bool:
        """Return whether an object is at rest: slower than 3 cm and half a radian per second."""
        at = self.scene.objects[name].v
        velocity = self.data.qvel[at : at + 6].tolist()
        return math.hypot(*velocity[:3]) < _AT_REST[0] and math.hypot(*velocity[3:]) < _AT_REST[1]

    def touched(self, name: str) -> bool:
        """Return whether every finger touches an object."""
        geom = self.scene.objects[name].geom
        return self.remember(
            ("touched", name), lambda: self.gripper.touches(self.model, self.data, geom)
        )

    def neighbours(self, name: str) -> list[tuple[float, float]]:
        """Return the offsets (x, y) [m] from an object to its neighbours within 8 cm.

        Each is from the object's centre to the nearest point of the neighbour. Neighbours are
        furniture and other objects that a hand over the object could hit, taken as axis-aligned
        boxes.

        Args:
            name: Name of the object.
        """
        others = self._standing[name]
        if not len(others):
            return []
        at, half = self.pose(name).position, self.model.geom_size[others]
        away = self.data.geom_xpos[others] - at
        # 0 along an axis on which they overlap
        nearest = away - np.minimum(np.maximum(away, -half), half)
        low, high = _BESIDE
        return [
            (x, y)
            for x, y, z in nearest.tolist()
            if low < z < high and 0 < math.hypot(x, y) < _NEAR
        ]

    @cached_property
    def _standing(self) -> Mapping[str, I64]:
        """For each object, the geoms of furniture and of the other objects."""
        objects, furniture = self.scene.objects, self.scene.furniture
        solid = furniture[self.scene.model.geom_contype[furniture] > 0].tolist()
        geoms = {name: one.geom for name, one in objects.items()}
        return {
            name: np.array(solid + [geoms[other] for other in geoms if other != name], np.int64)
            for name in geoms
        }

    @cached_property
    def reach(self) -> Reach:
        """Map of the points that the downward hand reaches."""
        return reach_of(self.robot)
