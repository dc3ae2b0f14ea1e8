"""What distinguishes recordings from others: digests of their folders. Imports no JAX."""

import hashlib
from pathlib import Path

from jaxunshear.config.image import Preprocess
from jaxunshear.data.recorded_contacts import read_folder


def compute_digest(folders: tuple[str, ...], pairs: str = "") -> str:
    """Sixteen hexadecimal digits of what lies in each folder: labels by their bytes, images by name and size; after a `p` those of a
    table of pairs. All joined by `+`, so that a folder is known beside others."""
    parts = [_folder_digest(Path(folder)) for folder in dict.fromkeys(folders)]
    if pairs and Path(pairs).is_file():
        parts.append("p" + hashlib.sha256(Path(pairs).read_bytes()).hexdigest()[:16])
    return "+".join(parts)


def parse_folder_digests(digest: str) -> set[str]:
    """The folders' own digests."""
    return {part for part in digest.split("+") if part and not part.startswith("p")}


def _folder_digest(folder: Path) -> str:
    digest, recordings = hashlib.sha256(), read_folder(str(folder), Preprocess())
    for file, name in zip(recordings.files, recordings.names, strict=True):
        digest.update(f"{name} {file.stat().st_size}\n".encode())
    for table in sorted(folder.rglob("*.csv")) if folder.is_dir() else []:
        digest.update(table.read_bytes())
    return digest.hexdigest()[:16]
