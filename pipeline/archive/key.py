"""The key of a result: it is used again only for the same scan, the same options and the same way of measuring."""

import hashlib
import json

from measure.results import MEASURE_REVISION
from pipeline.archive.file_state import Identity


def fingerprint(identity: Identity, options_hash: str, revision: int = MEASURE_REVISION) -> str:
    """SHA-256 (hexadecimal) of a scan's identity, the hash of its options, and the revision of `measure`. It is the
    same on every machine, so results of several may be joined."""
    state = identity.state
    told = [state.uri, state.bytes, state.mtime_ns, state.etag, identity.parts_hash, options_hash, revision]
    return hashlib.sha256(json.dumps(told).encode()).hexdigest()


def options_hash(options_json: str) -> str:
    """SHA-256 (hexadecimal) of a task's options."""
    return hashlib.sha256(options_json.encode("utf-8", "surrogateescape")).hexdigest()


def shard_of(name: str, shards: int) -> int:
    """Which of so many shards, 1 to N, an image is of: by its name, the same on every machine and in every run."""
    return int.from_bytes(hashlib.sha256(name.encode("utf-8", "surrogateescape")).digest()[:8]) % shards + 1
