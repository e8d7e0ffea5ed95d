"""Time that the `imitation` library takes to clone 200 demonstrations of gymnasium-robotics'
FetchPickAndPlace.

Run by `time_to_policy.py` in a separate environment, as `imitation` needs other versions than this
project; prints one line of JSON. Demonstrations are from a scripted expert of four rules, collected
in two processes; success is measured at the last step, on 200 unseen seeds.
"""

import json
import sys
import time

import gymnasium
import gymnasium_robotics  # noqa: F401  # pyright: ignore[reportUnusedImport]  registers the environments
import numpy as np
import torch
from gymnasium.wrappers import FlattenObservation
from imitation.algorithms.bc import BC  # pyright: ignore[reportMissingImports]
from imitation.data import rollout  # pyright: ignore[reportMissingImports]
from imitation.data.wrappers import RolloutInfoWrapper  # pyright: ignore[reportMissingImports]
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.vec_env import SubprocVecEnv

TASK, DEMONSTRATIONS, EPISODES = "FetchPickAndPlace-v2", 200, 200
# slices of the flat observation
GOAL, GRIPPER, CUBE, FINGERS = slice(3, 6), slice(6, 9), slice(9, 12), slice(15, 17)
OPEN, CLOSE, STEP = 1.0, -1.0, 0.1  # STEP: displacement by an action of 1, approximately [m]


def expert(seen: np.ndarray) -> np.ndarray:
    """Return actions (B, 4) for observations (B, 31): over the cube, down, close, carry."""
    actions = []
    for one in seen:
        to_cube = one[CUBE] - one[GRIPPER]
        is_closed = one[FINGERS].sum() < 0.052
        is_over, is_at = (
            np.hypot(*to_cube[:2]) < 0.015,
            abs(to_cube[2]) < (0.03 if is_closed else 0.01),
        )
        if not is_over:
            way, fingers = to_cube + [0, 0, 0.06], OPEN
        elif not is_at:
            way, fingers = to_cube, OPEN
        elif not is_closed:
            way, fingers = np.zeros(3), CLOSE
        else:
            way, fingers = one[GOAL] - one[CUBE], CLOSE
        actions.append(np.append(np.clip(way * 0.7 / STEP, -1, 1), fingers))
    return np.array(actions, np.float32)


def make():
    return RolloutInfoWrapper(FlattenObservation(gymnasium.make(TASK)))


def main() -> None:
    seed, epochs = int(sys.argv[1]), int(sys.argv[2])
    torch.manual_seed(seed)
    torch.set_num_threads(2)
    started = time.perf_counter()
    envs, rng = SubprocVecEnv([make] * 2), np.random.default_rng(seed)
    envs.seed(seed * 1_000_000)
    enough = rollout.make_sample_until(min_episodes=DEMONSTRATIONS)
    demonstrations = rollout.rollout(
        lambda seen, state, done: (expert(seen), None),
        envs,
        enough,
        rng,
        unwrap=False,
        exclude_infos=True,
    )
    policy = ActorCriticPolicy(
        envs.observation_space, envs.action_space, lambda _: 1e-3, net_arch=[256, 256]
    )
    trainer = BC(
        observation_space=envs.observation_space,
        action_space=envs.action_space,
        rng=rng,
        policy=policy,
        demonstrations=rollout.flatten_trajectories(demonstrations),
        batch_size=256,
        device="cpu",
    )
    trainer.train(n_epochs=epochs, progress_bar=False, log_interval=10_000)
    seconds = time.perf_counter() - started
    print(
        json.dumps(
            {
                "seconds": seconds,
                "labels": sum(map(len, demonstrations)),
                "success": success(policy),
            }
        )
    )


def success(policy: ActorCriticPolicy) -> float:
    env, solved = make(), 0
    for seed in range(10_000_000, 10_000_000 + EPISODES):
        seen, info = env.reset(seed=seed)
        done = False
        while not done:
            action, _ = policy.predict(seen, deterministic=True)
            seen, _, _, done, info = env.step(action)
        solved += int(info["is_success"])
    return solved / EPISODES


if __name__ == "__main__":
    main()
