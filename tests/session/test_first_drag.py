"""What a drag calls is compiled before the first visitor comes: nobody's first drag stands still for seconds."""

import subprocess
import sys

import first_drag
import pytest


@pytest.mark.long
def test_nothing_is_compiled_in_the_first_drag():
    said = subprocess.run([sys.executable, first_drag.__file__], capture_output=True, text=True, check=False)
    assert (said.stdout.strip(), said.stderr) == ("[]", "")
