"""What SOURCE of `ingest rosbag` is: one bag, or a folder of several."""

from __future__ import annotations

from pathlib import Path, PurePath

import yaml

from bask_data.errors import BadData, UsageError, imported
from bask_data.formats.choices import chosen_episode
from bask_data.formats.files import MAX_TEXT_BYTES, Folder, natural, read_bytes
from bask_data.formats.options.rosbag import RosbagOptions
from bask_data.formats.rosbag.bag import PARTS, Bag


def opened(source: Path, options: RosbagOptions) -> tuple[Bag, tuple[Path, ...]]:
    """The bag at `source`, or the one of those in it that `--episode` names; and the files that it is made of.

    Raises:
        UsageError: there is no bag, or there are several.
    """
    imported("rosbags", "rosbags", user="ingest rosbag", extra="formats")
    if not source.is_dir():
        if source.suffix.lower() not in PARTS:
            got = f"a file {source.suffix}" if source.exists() else "no such path"
            raise UsageError(source, "SOURCE", expected="a file .bag, .mcap or .db3, or a folder", got=got)
        path = Folder(source.parent, options.follow_links).member(source.name, "SOURCE")
        return Bag((path,)), (path,)
    if (source / "metadata.yaml").exists():
        return _ros2_folder(Folder(source, options.follow_links))
    names = found_bags(source)
    if not names:
        fix = "pass the .bag file, or the folder with metadata.yaml."
        raise UsageError(source, "SOURCE", expected="a bag of ROS 1 or ROS 2", got="a folder without one", fix=fix)
    folder = Folder(source, options.follow_links)
    if options.split:
        paths = tuple(folder.member(name, "SOURCE") for name in names.values() if (source / name).is_file())
        if not paths or len({path.suffix for path in paths}) > 1:
            got = ", ".join(list(names.values())[:5])
            raise UsageError("--split", expected="files of one kind in SOURCE", got=got, fix="leave it out.")
        return Bag(paths), paths
    name = names[chosen_episode(source, list(names), options.episode)]
    if (source / name).is_dir():
        # A link to a folder elsewhere would become the folder that all files must lie in.
        folder.member(f"{name}/metadata.yaml", "SOURCE")
        return _ros2_folder(Folder(source / name, options.follow_links))
    path = folder.member(name, "SOURCE")
    return Bag((path,)), (path,)


def found_bags(source: Path) -> dict[str, str]:
    """The bags in a folder that is none itself: names of files or folders, by the same without suffix if that is
    clear."""
    if not source.is_dir() or (source / "metadata.yaml").exists():
        return {}
    names = [
        path.name
        for path in source.iterdir()
        if not path.name.startswith(".") and (path.suffix.lower() in PARTS or (path / "metadata.yaml").is_file())
    ]
    stems = [PurePath(name).stem if (source / name).is_file() else name for name in names]
    bags = {stem if stems.count(stem) == 1 else name: name for stem, name in zip(stems, names, strict=True)}
    return {name: bags[name] for name in sorted(bags, key=natural)}


def _ros2_folder(folder: Folder) -> tuple[Bag, tuple[Path, ...]]:
    """A bag of ROS 2: the files that metadata.yaml lists."""
    about = folder.member("metadata.yaml", "SOURCE")
    try:
        document = yaml.safe_load(read_bytes(about, MAX_TEXT_BYTES))
        listed = [PurePath(name).name for name in document["rosbag2_bagfile_information"]["relative_file_paths"]]
    except (yaml.YAMLError, KeyError, TypeError, ValueError, RecursionError) as error:
        got = f"{type(error).__name__}: {error}"[:200]
        fix = "pass the .mcap or .db3 file itself."
        raise BadData(about, "relative_file_paths", expected="the names of files", got=got, fix=fix) from error
    paths = []
    for name in listed:
        plain = name.removesuffix(".zstd")
        if plain != name and not folder.has(plain) and folder.has(name):
            fix = f"decompress it, once: zstd -d {folder.path / '*.zstd'}"
            raise BadData(folder.path / name, "compression", expected="files as recorded", got="zstd", fix=fix)
        paths.append(folder.member(plain, "metadata.yaml"))
    if not paths or any(path.suffix.lower() not in PARTS for path in paths):
        got = ", ".join(listed[:5]) or "none"
        raise BadData(about, "relative_file_paths", expected="files .mcap or .db3", got=got)
    return Bag(tuple(paths)), (about, *paths)
