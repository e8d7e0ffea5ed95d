"""`gym_aloha`'s two ViperX arms: `--robot.type=aloha --task.type=AlohaTransferCube-v0`, `AlohaInsertion-v0`.

- Unmodified: own model, 50 Hz, actions, pictures and reward; an episode is solved at the first reward of 4.
- `action`, `observation.state`: 14 numbers with the names of `lerobot/aloha_sim_*`: of either arm six joints [rad] and
  the gripper, 0 closed to 1 open. `observation.images.top`: what the environment draws, at the size asked for.
- A state is MuJoCo's integration state: the environment leaves all poses as of the end of a step.
- The expert is a ladder a hand over what `Scene` reads of a state. A task is one file: a `Scene` with the facts that
  its rungs ask for, and the rungs.
"""
