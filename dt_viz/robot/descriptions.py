"""Arms of the package robot_descriptions, where that is installed: nothing is ever downloaded."""

from __future__ import annotations

import importlib
import os
from pathlib import Path
from typing import Any

from dt_viz.robot.urdf import ArmError


def description_of(name: str, others: str) -> tuple[Path, list[Path]]:
    """Return the URDF of an arm, such as "gen3", that the package knows and has downloaded, and folders of its meshes.

    The message of an error says that the `others` are accepted, too.

    Raises:
        ArmError: There is no such arm, it is not downloaded, or has no URDF.
    """
    accepted = f"{others}; or a name of the package robot_descriptions"
    try:
        cache: Any = importlib.import_module("robot_descriptions._cache")
        repositories = importlib.import_module("robot_descriptions._repositories").REPOSITORIES
    except ImportError as error:
        raise ArmError("arm", "name", repr(name), f"{accepted}: pip install robot_descriptions") from error
    module, way_out = f"{name.removesuffix('_description')}_description", f"robot_descriptions pull {name}"

    def there(repository: str, **_: object) -> str:
        path = _folder(repositories[repository])
        if not path.is_dir():
            raise ArmError("arm", "name", f"{name!r}, which is not on this machine yet", f"after: {way_out}")
        return str(path)

    cloning, cache.clone_to_cache = cache.clone_to_cache, there  # which its modules call: nothing is downloaded
    try:
        description = importlib.import_module(f"robot_descriptions.{module}")
    except ModuleNotFoundError as error:
        raise ArmError("arm", "name", repr(name), accepted) from error
    finally:
        cache.clone_to_cache = cloning
    path = getattr(description, "URDF_PATH", None)
    if path is None:
        raise ArmError(
            "arm", "name", f"{name!r}, a description without a URDF", "a URDF; expand a xacro file first: xacro FILE"
        )
    folders = [
        Path(getattr(description, key)) for key in ("PACKAGE_PATH", "REPOSITORY_PATH") if hasattr(description, key)
    ]
    return Path(path), [*folders, *(folder.parent for folder in folders)]


def local_descriptions() -> tuple[str, ...]:
    """Names of the arms that the package has downloaded; none without it."""
    try:
        listed = importlib.import_module("robot_descriptions._descriptions").DESCRIPTIONS
        repositories = importlib.import_module("robot_descriptions._repositories").REPOSITORIES
    except ImportError:
        return ()
    return tuple(
        name.removesuffix("_description")
        for name, each in listed.items()
        if each.has_urdf and "arm" in each.tags and _folder(repositories.get(each.repository)).is_dir()
    )


def _folder(repository: Any) -> Path:  # noqa: ANN401 - of that package; None is of no file
    """Return the folder of a repository, which is there once it was downloaded."""
    folder = Path(os.environ.get("ROBOT_DESCRIPTIONS_CACHE", "~/.cache/robot_descriptions")).expanduser()
    return folder / getattr(repository, "cache_path", "none")
