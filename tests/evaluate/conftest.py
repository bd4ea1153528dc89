"""Measurements find what was learned where the tests store it."""

import json

import numpy as np
import pytest
from hook import write_mat

from dt_viz.evaluate.__main__ import main as evaluate


@pytest.fixture(scope="module", autouse=True)
def fits_of_the_tests(cache):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(cache))
        yield


@pytest.fixture(scope="module")
def lasa(tmp_path_factory):
    folder = tmp_path_factory.mktemp("lasa")
    write_mat(folder / "Hook.mat")
    return folder


@pytest.fixture
def measured(lasa, tmp_path, capsys):
    """Runs a command on the hook: what it writes (npz) and the tables that it prints."""

    def run(command, options, form="npz"):
        out, tables = tmp_path / f"{command}.{form}", tmp_path / "tables.json"
        arguments = ["--task", "Hook", "--lasa", str(lasa), *options.split(), "--out", str(out)]
        assert evaluate([command, *arguments, "--tables", str(tables)]) == 0
        printed = json.loads(tables.read_text())["tables"]
        capsys.readouterr()
        if form == "json":
            return printed
        with np.load(out) as arrays:
            return dict(arrays), printed

    return run
