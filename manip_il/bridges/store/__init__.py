"""Push and pull of datasets and policies: `manip-il push` and `manip-il pull`.

huggingface_hub accesses the Hub, fsspec all other stores; we add the manifest, the order of writes
and the checks. The guarantees, and the tests in `tests/store` for them:

- A pull returns what was pushed, and only changes are sent:
  `test_a_run_comes_back_as_it_was_and_only_changes_travel`.
- Readers see the old version or the new one: `test_a_reader_of_the_version_before_finishes_...`.
- Of two pushes one wins, and the other fails: `test_of_two_pushes_one_wins_and_the_other_is_told`.
- A killed transfer leaves no half version: `test_a_killed_transfer`.
- A pull verifies every hash: `test_bytes_that_differ_are_refused`.
- Nothing is written outside the target folder:
  `test_a_hostile_manifest_is_refused_and_nothing_is_written`, `test_whatever_a_manifest_holds_...`.
- Nothing of others is replaced or deleted:
  `test_a_push_removes_nothing_from_a_store`,
  `test_what_others_keep_in_a_repository_stays_...`.
- No more arrives than the remote lists: `test_a_file_that_is_larger_than_the_list_says_...`,
  `test_an_answer_without_an_end_...`.
- A dataset is checked first, and links are not followed:
  `test_a_dataset_is_examined_before_its_push_and_...`.
- Unknown hosts are refused, and an error is one line: `test_a_mistake_is_one_line`.
- Secrets are never printed, and go to the Hub alone: `test_no_token_is_said`,
  `tests/cli/test_secrets.py`.
- A card makes no claims about others' work:
  `test_a_datasets_card_says_what_the_hub_reads_and_...`.
"""
