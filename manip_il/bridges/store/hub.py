"""Push to and pull from the Hugging Face Hub, or the server at HF_ENDPOINT, and write cards.

Files keep their paths, so that LeRobot reads them. A push is one commit on top of the version that
the folder was compared with; then the tag `v3.0`, by which LeRobot finds datasets, is moved to that
commit. The Hub provides the size and hash of each file of a commit; a manifest lists those that a
push wrote, since a repository may hold others.

The card, `README.md`, is made from `card.md.jinja`. It holds no absolute path, token or date, so
that the same folder gives the same bytes. A card of another program's dataset or policy claims
neither our licence nor our authorship.
"""

import re
import shlex
import tempfile
from collections.abc import Collection, Generator, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import httpx
import jinja2
from huggingface_hub import (
    CommitOperationAdd,
    CommitOperationDelete,
    HfApi,
    RepoFile,
    constants,
    set_client_factory,
)
from huggingface_hub.errors import (
    RemoteEntryNotFoundError,
    RepositoryNotFoundError,
    RevisionNotFoundError,
)
from huggingface_hub.utils import disable_progress_bars
from huggingface_hub.utils._http import default_client_factory

from manip_il import checks
from manip_il.bridges.store.errors import SENT, RemoteError, explained, redact
from manip_il.bridges.store.manifest import (
    CARD,
    CONFIG,
    MANIFEST_FILE,
    Arrival,
    File,
    Kind,
    Manifest,
    PushPlan,
    policy_folder,
)
from manip_il.data.dataset import Dataset
from manip_il.data.fingerprint import policy_sha256
from manip_il.data.lerobot_layout import VERSION
from manip_il.errors import ManipError, UsageError
from manip_il.sim.conditions import NOMINAL
from manip_il.worlds.table import world_of

_ADDRESS = re.compile(
    r"(datasets/|models/)?((?!datasets/|models/)\w[\w.-]*/\w[\w.-]*)(?:@(\w[\w./-]*))?"
)
_HIDDEN = re.compile(r"(.*/)?\.[^./]")  # such as the Hub's own .gitattributes
_COMMIT = re.compile(r"[0-9a-f]{40}")
_OF_A_DATASET = ("data/", "meta/", "videos/")  # the layout's folders, which are replaced as one
_OURS = b"<!-- written by manip-il push -->"  # a card with this line is ours and is replaced
_ANSWERS = ContextVar[Arrival | None]("_ANSWERS", default=None)  # of the action in progress


def _guard_token(request: httpx.Request) -> None:
    """Remember the token, and remove it if another server is asked, as a page of a listing may
    name one.
    """
    SENT.add(request.headers.get("authorization", "").removeprefix("Bearer "))
    if not str(request.url).startswith(f"{constants.ENDPOINT}/"):
        request.headers.pop("authorization", None)


def _count(response: httpx.Response) -> None:
    """Count an answer's bytes, as decompressed, whoever reads it."""
    arrival, chunks = _ANSWERS.get() or Arrival(checks.LARGEST_READ), response.iter_bytes

    def counted(chunk_size: int | None = None) -> Iterator[bytes]:
        for chunk in chunks(chunk_size):
            arrival.update(len(chunk))
            yield chunk

    response.iter_bytes = counted


@contextmanager
def _bounded(size: int = 0) -> Generator[None]:
    """Bound all answers in this block together. size: of the file that they bring."""
    token = _ANSWERS.set(Arrival(checks.LARGEST_READ + size))
    try:
        yield
    finally:
        _ANSWERS.reset(token)


@cache
def _use_client() -> None:
    """Have huggingface_hub guard the token and count what arrives from now on."""
    set_client_factory(_client)


def _client() -> httpx.Client:
    client = default_client_factory()
    client.event_hooks = {
        "request": [*client.event_hooks["request"], _guard_token],
        "response": [_count],
    }
    return client


class Hub:
    """A repository on the Hub at a branch, tag or commit.

    Attributes:
        at_once: Number of files that are transferred concurrently.
        kind: Whether the repository holds a dataset or a policy.
        name: The address, for messages.
        quiet: Whether progress bars are hidden.
    """

    at_once = 8  # concurrent files

    def __init__(
        self,
        address: str,
        revision: str | None = None,
        *,
        private: bool = False,
        quiet: bool = False,
    ):
        """Parse the address of a repository, without connecting to the Hub.

        Args:
            address: The part of the URL after `hf://`.
            revision: Branch, tag or commit, by default the one in the address or the main branch.
            private: Whether a push creates a private repository.
            quiet: Whether to hide progress bars.

        Raises:
            UsageError: if the address is invalid, or names another revision than `revision`.
        """
        found = _ADDRESS.fullmatch(address)
        if not found or ".." in address or (revision and found[3] not in (None, revision)):
            text = (
                "expected hf://datasets/USER/NAME[@REVISION] or hf://USER/NAME[@REVISION], and one"
                " revision"
            )
            raise UsageError(f"the hf:// address is invalid; {text}")
        self.kind: Kind = "dataset" if found[1] == "datasets/" else "policy"
        self._place = found[2]
        self._revision = revision or found[3]
        self._private = private
        self._repo: Any = {
            "repo_id": self._place,
            "repo_type": "dataset" if self.kind == "dataset" else "model",
        }
        self.name = (
            f"hf://{found[1] or ''}{self._place}{f'@{self._revision}' if self._revision else ''}"
        )
        self.quiet = quiet
        _use_client()
        self._api = HfApi(library_name="manip_il")
        if quiet:
            disable_progress_bars()

    def read(self) -> Manifest | None:
        """Return the current version; None if the repository or the revision does not exist."""
        with explained(f"read {self.name}"), _bounded():
            try:
                about: Any = self._api.repo_info(**self._repo, revision=self._revision)
            except (RepositoryNotFoundError, RevisionNotFoundError):
                return None
            head = about.sha or ""
            if not _COMMIT.fullmatch(head):  # becomes part of paths
                raise RemoteError(
                    f"{self.name} names the commit {checks.shorten(head)}; is HF_ENDPOINT a Hub?"
                )
            tree = self._api.list_repo_tree(**self._repo, revision=head, recursive=True)
            listed = {entry.path: entry for entry in tree if isinstance(entry, RepoFile)}
            if missing := {entry.rfilename for entry in about.siblings or ()} - listed.keys():
                text = (
                    f"its list of files lacks {checks.shorten(min(missing))}, which the commit has;"
                    " try again"
                )
                raise RemoteError(f"{self.name}: {text}")
            files = {
                path: (
                    File(entry.lfs.size, entry.lfs.sha256)
                    if entry.lfs
                    else File(entry.size, git_sha1=entry.blob_id)
                )
                for path, entry in listed.items()
                if not _HIDDEN.match(path) and path != MANIFEST_FILE
            }
            copies = self._copies(files)
            are_equal = all(files.get(name) == files[path] for name, path in copies.items())
            return Manifest(self.kind, files, head, copies=frozenset(copies if are_equal else ()))

    def _copies(self, paths: Collection[str]) -> dict[str, str]:
        """Return which files of a run's policy are copied to the root, name -> path."""
        folder = (
            policy_folder(path for path in paths if path != CONFIG)
            if self.kind == "policy"
            else None
        )
        inside = {
            Path(path).name: path for path in paths if folder and str(Path(path).parent) == folder
        }
        return {name: path for name, path in inside.items() if name != CARD}

    def pushed(self, before: Manifest) -> dict[str, File]:
        """Return the files of a version that a push wrote, by its manifest in the repository,
        without an edited card.

        Without a manifest these are the folders of a dataset.
        """
        with (
            tempfile.TemporaryDirectory(prefix="manip_il_manifest_") as folder,
            explained(f"read {self.name}"),
        ):
            try:
                self.download(before, Path(folder), MANIFEST_FILE)
            except RemoteEntryNotFoundError:
                named = _OF_A_DATASET if self.kind == "dataset" else ()
                return {path: file for path, file in before.files.items() if path.startswith(named)}
            content = checks.read_bytes(Path(folder, MANIFEST_FILE), "a manifest")
            pushed = dict(Manifest.from_json(content, before.version).files)
            if CARD in pushed.keys() & before.files.keys():
                self.download(before, Path(folder), CARD)
                if not pushed[CARD].fits(Path(folder, CARD)):
                    del pushed[CARD]
            return pushed

    def with_card(
        self, source: Path, local: Mapping[str, Path], folder: Path, keeps: bool
    ) -> dict[str, Path]:
        """Return the files to push: `local`, a card, and a run's policy at the root.

        Args:
            source: The dataset, run or policy.
            local: Its files by their paths in the repository.
            folder: Where the card is written.
            keeps: Whether the repository keeps its own card.
        """
        added = write_cards(source, self.kind, self._place, folder)
        if keeps and added.pop(CARD, None):
            local = {path: file for path, file in local.items() if path != CARD}
        copies = self._copies(local)
        if not copies.keys() & local.keys():
            added |= {name: local[path] for name, path in copies.items()}
        return {**local, **added}

    def write(self, plan: PushPlan) -> None:
        """Commit on top of `plan.before` (the Hub refuses if it is outdated), then move a
        dataset's tag.
        """
        with explained(f"push to {self.name}"), _bounded():
            before, gone = plan.before or self._create(), plan.remove
            if plan.before is None:  # a new branch begins with the files of the main branch
                gone = sorted(
                    before.files.keys() & self.pushed(before).keys() - plan.manifest.files.keys()
                )
            operations = [
                *(CommitOperationAdd(path, str(plan.local[path])) for path in plan.upload),
                *(CommitOperationDelete(path, is_folder=False) for path in gone),
            ]
            on: Any = {"revision": self._revision, "parent_commit": before.version}
            if operations:
                operations.append(CommitOperationAdd(MANIFEST_FILE, plan.manifest.to_json()))
                self._api.create_commit(
                    **self._repo, operations=operations, commit_message="manip-il push", **on
                )
            if self.kind == "dataset" and self._revision in (None, "main"):
                self._move_tag()

    def download(self, manifest: Manifest, folder: Path, path: str) -> None:
        """Download one file of a version, without checking its hash.

        Args:
            manifest: The version.
            folder: Where the file is written, at the same path as in the repository.
            path: The file's path in the repository.

        Raises:
            RemoteError: if the server sends more bytes than expected.
        """
        file = manifest.files.get(path)
        most = file.size if file else checks.LARGEST_READ
        where: Any = {**self._repo, "revision": manifest.version, "local_dir": folder}
        where["tqdm_class"] = Arrival(most)  # some servers send a file by other means than answers
        with _bounded(most):
            self._api.hf_hub_download(filename=path, force_download=True, **where)

    def _create(self) -> Manifest:
        """Create the repository and the branch.

        Return the branch's content: empty, or as on the main branch.
        """
        self._api.create_repo(**self._repo, private=self._private, exist_ok=True)
        if self._revision:
            self._api.create_branch(**self._repo, branch=self._revision, exist_ok=True)
        made = self.read()
        if made is None or (made.files and not self._revision):
            raise RemoteError(
                f"{self.name} was created by another push in the meantime; push again"
            )
        return made

    def _move_tag(self) -> None:
        """Delete LeRobot's tag and create it again on the main branch, because the Hub cannot
        move tags.
        """
        refs = self._api.list_repo_refs(**self._repo)
        [head] = [branch.target_commit for branch in refs.branches if branch.name == "main"]
        tags = [tag.target_commit for tag in refs.tags if tag.name == VERSION]
        if tags != [head]:
            if tags:
                self._api.delete_tag(**self._repo, tag=VERSION)
            self._api.create_tag(**self._repo, tag=VERSION, revision=head, exist_ok=True)


def write_cards(root: Path, kind: Kind, place: str, folder: Path) -> dict[str, Path]:
    """Write a card.

    Return it by its path in the repository, or {} if `root` has one that is not ours.

    Args:
        root: A dataset, run or policy.
        kind: Which of them.
        place: USER/NAME.
        folder: Where the card is written.

    Raises:
        ManipError: The folder cannot be read.
    """
    if (root / CARD).is_file() and _OURS not in checks.read_bytes(root / CARD, "a card"):
        return {}
    environment = jinja2.Environment(finalize=_shown)
    environment.filters["word"] = lambda value: shlex.quote(_shown(str(value)))
    environment.filters["cell"] = lambda value: " ".join(str(value).split()).replace("|", "\\|")
    template = Path(__file__).with_name("card.md.jinja").read_text(encoding="utf-8")
    with explained(f"write a card of {root}"):  # its JSON files may hold any values
        facts = {"dataset": Dataset.open(root)} if kind == "dataset" else policy_facts(root)
        about = {"place": place, "version": version("manip_il")}
        text = environment.from_string(template).render(facts, **about)
    (folder / CARD).write_text(f"{text}\n", encoding="utf-8")
    return {CARD: folder / CARD}


def _shown(value: Any) -> Any:
    """Return a value as a card shows it: text on one line, without secrets."""
    return redact(" ".join(value.splitlines())) if isinstance(value, str) else value


def policy_facts(root: Path) -> dict[str, Any]:
    """Return the template's values for a policy or its run.

    Raises `ManipError` if there is no policy.
    """
    inside = policy_folder(path.relative_to(root).as_posix() for path in root.rglob(CONFIG))
    if inside is None:
        raise ManipError(
            f"no policy in {root}; push a run that has saved a checkpoint, or a pretrained_model"
            " folder"
        )
    facts: dict[str, Any] = {}
    for name in ("config", "manip_il", "train_config"):
        path = root / inside / f"{name}.json"
        facts[name] = checks.read_json(path, "JSON") if path.is_file() else {}
    robot, task = (facts["manip_il"].get(name) or "" for name in ("robot", "task"))
    facts["lerobot_words"] = world_of(robot, task).lerobot_words(robot, task)
    own = policy_sha256(root / inside)
    evaluations = [  # of this policy, undisturbed, and not on the seeds that chose it
        result
        for path in root.rglob("eval.json")
        if not any(
            part.startswith(("round_", "validation")) for part in path.relative_to(root).parts
        )
        and (result := checks.read_json(path, "JSON")).get("policy_sha256") == own
        and result.get("settings", {}).get("suite", NOMINAL.name) == NOMINAL.name
    ]
    facts["evaluation"] = max(evaluations, key=lambda result: result["n_episodes"], default={})
    return facts
