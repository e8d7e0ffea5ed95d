"""Push and pull of datasets and policies: `manip-il push FOLDER REMOTE` and `manip-il pull REMOTE FOLDER`.

huggingface_hub speaks to the Hub and fsspec to every other store; ours are the manifest, the order and the checks.
"""
