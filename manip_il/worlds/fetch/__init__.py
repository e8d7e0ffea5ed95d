"""Fetch's benchmark environments, `FetchReach-v4` and siblings of gymnasium-robotics, unmodified.

- `--robot.type=fetch_stock --task.type=FetchPush-v4` chooses one.
- Unmodified: the environment's own model, 25 Hz, action and reward; other settings are refused, and
  so are cameras, disturbances and suites of conditions. In `eval.json`, `return` is an episode's
  sum of rewards.
- `action`: [dx, dy, dz, fingers] in [-1, 1], where 1 is 5 cm. `agent_pos`: the gripper's position
  and opening, so that state and action have the same size. `environment_state`: the environment's
  whole observation and the desired goal.
- A state is MuJoCo's integration state, and the positions and velocities before the last physics
  step: MuJoCo computes poses at the beginning of a step, and observation and next action depend on
  those. `variation` is the goal.
- The expert is a ladder over gripper, object and goal, a function of the state alone, as for our
  own tasks.
"""
