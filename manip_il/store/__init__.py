"""Push and pull of datasets and policies: `manip-il push FOLDER REMOTE` and `manip-il pull REMOTE FOLDER`.

A remote is the Hugging Face Hub, an S3 bucket, a folder on an SSH server, or a folder of this machine. This package
moves a folder there and back, and promises the following of each.

**An unfinished push is never visible.** Readers see the old version until every file of the new one is on the remote
and verified; then one step switches all of them over. On S3, SFTP and folders, files are objects named by their sha256
and never changed, and the step replaces the one manifest that names them. On the Hub the step is one commit. A push
that is killed, cut or refused leaves readers the version that they had. A new push uploads only what is missing, and
continues large S3 uploads at the first part that is missing.

**A pull is whole or resumes.** Files arrive in a hidden folder beside the target, `.NAME.pulling`. Each is hashed on
its way; a file that was cut continues at the byte where it ended. The target appears by one rename after every file
is verified and on the disk. A pull that is killed leaves no target, and the next one reuses what has arrived. The
replaced version's objects stay on the remote until the next push, so a pull that has begun can finish.

**Everything from outside is checked.** A manifest, a list of files and every other answer of a server may be hostile.
`manifest.FileEntry` and `manifest.Manifest` refuse themselves on construction: paths that leave the folder, links,
pickles, code, names that are equal on some file system, impossible sizes and hashes. Bytes count only once their hash
is right. Answers have a largest size, a longest time and a least speed, lists a largest number of pages. Nothing that
was pulled is executed. Whatever a server sends, a command ends with one line that says what to do.

**Secrets are never printed.** Every `RemoteError` removes tokens, keys, passwords and signatures from its text. A URL
is printed without its password. The Hub's token goes to the origin of HF_ENDPOINT alone and no S3 request follows a
redirect to another origin. Cards contain no absolute path and nothing that looks like a secret.

**Locks let one of two pushes win.** A push names the version that it read, and the remote switches only from that
version; otherwise `ConflictError` tells the user to push again.

    Hub      a commit on top of the parent that was read
    S3       If-Match and If-None-Match; a store that ignores them is found by a probe, and the user is warned
    SFTP     a lock file, made only where there is none and touched every 3 s; one not touched for 15 s is removed
    folder   the kernel's lock on the manifest, which a killed process cannot keep; without locks the user is warned

The files, from the commands downwards:

    push, pull                      the two procedures, for any remote
    remote                          URLs, and the protocol `Remote` that every remote implements
    manifest                        the list of files of one version, and which paths it may hold
    disk, errors                    local files and downloads; errors, retries and the least speed
    hub, hub_repo, hub_session,     the Hub: push and pull, one repository's API, errors in our words,
      hub_http                        and the HTTP client with its limits
    object_store                    `Remote` on top of any store of plain files (`Blobs`)
    s3_store, s3_upload, s3_client  `Blobs` on S3; large files in parts; the HTTP session and its errors
    sftp_store, sftp_connection     `Blobs` over SFTP with its lock; the connection and its pipelined reads
    file_store                      `Blobs` in a folder
    cards, card_policy, card_dataset
                                    README.md and picture for the Hub, from the templates card_*.md.jinja

Importing this package does nothing; each remote's library is imported when a URL of its kind is opened.
"""
