"""Compute digests of recordings, by which they are distinguished. Imports no JAX."""

import hashlib
from pathlib import Path

from jaxunshear.config.sensor import Preprocess
from jaxunshear.data.recorded_contacts import read_folder

DIGITS = 16
PAIRS_PREFIX = "p"


def compute_digest(folders: tuple[str, ...], pairs: str = "") -> str:
    """Compute the digest of each folder, and of a table of pairs if there is one, joined by `+`.

    Each has sixteen hexadecimal digits; those of the table follow a `p`. A folder's digest is of
    its labels by their bytes and its images by name and size, so it is the same beside other
    folders.
    """
    parts = [_compute_folder_digest(Path(folder)) for folder in dict.fromkeys(folders)]
    if pairs and Path(pairs).is_file():
        parts.append(PAIRS_PREFIX + hashlib.sha256(Path(pairs).read_bytes()).hexdigest()[:DIGITS])
    return "+".join(parts)


def parse_folder_digests(digest: str) -> set[str]:
    """Return the digests of the folders in a joined digest."""
    return {part for part in digest.split("+") if part and not part.startswith(PAIRS_PREFIX)}


def _compute_folder_digest(folder: Path) -> str:
    digest, recordings = hashlib.sha256(), read_folder(str(folder), Preprocess())
    for file, name in zip(recordings.files, recordings.names, strict=True):
        digest.update(f"{name} {file.stat().st_size}\n".encode())
    for table in sorted(folder.rglob("*.csv")) if folder.is_dir() else []:
        digest.update(table.read_bytes())
    return digest.hexdigest()[:DIGITS]
