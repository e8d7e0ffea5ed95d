"""`gym_aloha`'s two ViperX arms: `--robot.type=aloha --task.type=AlohaTransferCube-v0`,
`AlohaInsertion-v0`.

- Unmodified: own model, 50 Hz, actions, pictures and reward; an episode is solved at the first
  reward of 4.
- `action`, `observation.state`: 14 numbers with the names of `lerobot/aloha_sim_*`: for each arm
  six joints [rad] and the gripper, 0 closed to 1 open. `observation.images.top`: the environment's
  own picture, at the size asked for.
- A state is MuJoCo's integration state: after a step all poses are up to date.
- The expert is one ladder per hand over what `AlohaScene` reads from a state. A task is one file
  and one `AlohaScene`, with the facts that its rungs need, as properties, and the rungs.
"""
