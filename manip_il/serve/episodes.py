"""Successive worlds of a session, and a log of what the client does not see: states, labels, and
who drove.

A frame is logged when the client reads the follower's position, so that the frames match those of
its own dataset.
"""

from pathlib import Path

from manip_il.collect.edits import SERVED
from manip_il.data.atomic import EPISODES, require_ours
from manip_il.data.build import Recording
from manip_il.data.episodes import to_episode
from manip_il.data.journal import Journal, list_seeds
from manip_il.errors import UsageError
from manip_il.mdp import Actor, Transition
from manip_il.seeding import BLOCK, stream_seeds
from manip_il.serve.station import Mover, Read, Station
from manip_il.worlds.config import EnvConfig
from manip_il.worlds.ladder.expert import LadderExpert
from manip_il.worlds.ladder.world import LadderEnv
from manip_il.worlds.table import env_fingerprint, env_spec


class ServedEpisodes:
    """Episodes of a station.

    Those to keep are written as journals to a folder, for `manip-il data build`.

    Attributes:
        driver: Who moves the follower now.
    """

    def __init__(
        self, station: Station, config: EnvConfig, folder: Path | None, seed: int, leader: Mover
    ):
        """Prepare the folder and draw the first world.

        Args:
            station: The station.
            config: The station's environment.
            folder: Folder of the journals; None to write none.
            seed: Seed of the stream of worlds, `--seed`; worlds with a journal in the folder are
                not drawn again.
            leader: The function that moves the leader.

        Raises:
            UsageError: If the folder holds something else, such as journals of `manip-il record`.
            MismatchError: If the folder's journals are of another robot, task or cameras.
        """
        self._station = station
        self._env = LadderEnv(config)
        self._leader = leader
        self._expert = LadderExpert(station.env.scene)
        self.driver = Actor.EXPERT
        self._reads: list[tuple[Read, Actor]] | None = None
        self._journal: Journal | None = None
        there: list[int] = []
        if folder is not None:
            require_ours(folder, EPISODES)
            self._journal = Journal(folder, env_spec(config), env_fingerprint(config))
            self._journal.prepare()
            recording = Recording.read(folder)
            if recording.provenance.get("driver", SERVED) != SERVED:
                raise UsageError(
                    f"--log={folder} holds journals of manip-il record; choose another folder"
                )
            Recording(provenance={"driver": SERVED}).write(folder)
            there = list_seeds(folder)
        self._seeds = (
            number for number in stream_seeds("demonstrations", BLOCK, seed) if number not in there
        )
        self.renew()

    def renew(self, *, keep: bool = True) -> None:
        """End the episode and draw the next world, in which nothing moves yet."""
        self.end(keep=keep)
        self._station.mover = lambda: None
        self._station.reset(next(self._seeds))

    def begin(self, driver: Actor) -> None:
        """Begin an episode in the current world."""
        self._reads = []
        self.drive(driver)

    def drive(self, driver: Actor) -> None:
        """Set who moves the follower from now on: the leader if `driver` is the expert, else the
        program's policy.
        """
        leads = driver is Actor.EXPERT
        self._station.mover = self._leader if leads else lambda: None
        self.driver = driver if not leads or self._leader == self._station.expert else Actor.LEARNER

    def frame(self, read: Read) -> None:
        """Log one read of the follower's position by the client."""
        reads = self._reads
        if reads is not None and self._journal is not None:
            if reads and reads[-1][0].commands == read.commands:
                reads.pop()  # the client asks again, as it got no answer
            reads.append((read, self.driver))

    def end(self, *, keep: bool) -> None:
        """End the episode; if it is to be kept, write its journal at once."""
        reads, self._reads = self._reads, None
        if self._journal is not None and keep and reads:
            reads.append((self._station.look(), self.driver))
            frames = [self._transition(step, reads) for step in range(len(reads) - 1)]
            self._journal.write(to_episode(frames))

    def _transition(self, step: int, reads: list[tuple[Read, Actor]]) -> Transition:
        """Return the frame of one read, with the command and the outcome at the next read."""
        (now, actor), (after, _) = reads[step : step + 2]
        env = self._env
        env.set_state(self._station.as_named(after.state))
        reward, success = env.reward, env.solved
        env.set_state(state := self._station.as_named(now.state))
        return Transition(
            seed=self._station.seed,
            step=step,
            state=state,
            observation=env.observe(),
            label=self._expert.label(now.state),
            executed_action=self._station.to_action(after.told),
            actor=actor,
            reward=reward,
            success=success,
            done=step == len(reads) - 2,
            progress=env.progress,
        )
