"""The schemas of all kinds as JSON, rendered from the code into `schemas/`."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from bask_data.artifact import Artifact, Manifest
from bask_data.dataset import DatasetFile
from bask_data.kinds import KINDS

FOLDER = Path(__file__).parent.parent / "schemas"


def schema_of(kind: type[Artifact]) -> dict[str, Any]:
    """Schema of a kind: metadata as JSON Schema, arrays, tables, and further files in words."""
    return {
        "kind": kind.kind,
        "schema": kind.schema_version,
        "scope": kind.scope,
        "variants": kind.has_variants,
        "description": (kind.__doc__ or "").strip(),
        "metadata": kind.metadata_model.model_json_schema(),
        "arrays": {
            name: {
                "dims": list(spec.dims),
                **({"other_dims": list(spec.other_dims)} if spec.other_dims else {}),
                "dtype": spec.dtype,
                "units": spec.units,
                "description": spec.description,
                "attributes": list(spec.attributes),
                "optional": spec.optional,
            }
            for name, spec in kind.arrays.items()
        },
        "tables": {
            name: {column: {"type": type_, "description": text} for column, (type_, text) in spec.columns.items()}
            for name, spec in kind.tables.items()
        },
        "files": kind.files,
    }


def render() -> dict[str, str]:
    """Content by file name of the folder `schemas/`."""
    documents: dict[str, Any] = {f"{kind.kind}.v{kind.schema_version}.json": schema_of(kind) for kind in KINDS}
    documents["dataset.v1.json"] = DatasetFile.model_json_schema()
    documents["artifact.v1.json"] = Manifest.model_json_schema()
    return {name: json.dumps(document, indent=2, ensure_ascii=False) + "\n" for name, document in documents.items()}


OLDER = {f"{kind.kind}.v{version}.json" for kind in KINDS for version in kind.opens}
"""Files of versions that are still opened. They are kept as they were: no code renders them any more."""


def differences() -> list[str]:
    """Names of files in `schemas/` that differ from what the code renders, and of older ones that are missing."""
    rendered = render()
    on_disk = {file.name: file.read_text() for file in FOLDER.glob("*.json")}
    rendered |= {name: on_disk.get(name, "") for name in OLDER}
    return sorted(name for name in rendered.keys() | on_disk.keys() if rendered.get(name) != on_disk.get(name))


def main() -> None:
    """Write the folder, or with `--check` only print what differs."""
    if "--check" in sys.argv[1:]:
        changed = differences()
        if changed:
            sys.exit(f"schemas differ from the code: {', '.join(changed)}  fix: python -m bask_data.schemas")
        return
    FOLDER.mkdir(exist_ok=True)
    for file in FOLDER.glob("*.json"):
        if file.name not in OLDER:
            file.unlink()
    for name, content in render().items():
        (FOLDER / name).write_text(content)


if __name__ == "__main__":
    main()
