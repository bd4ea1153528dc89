"""Tables of the documents: they are made from the rows of one sitting."""

import json

import pytest

from tests.benchmarks import documents, sitting
from tests.benchmarks.__main__ import main


@pytest.mark.parametrize("document", documents.DOCUMENTS, ids=lambda path: str(path.relative_to(documents.ROOT)))
def test_the_tables_of_a_document_are_those_of_the_sitting_that_is_kept(document):
    text = document.read_text(encoding="utf-8")
    assert text == documents.filled(text)


@pytest.mark.parametrize("name", documents.TABLES_OF)
def test_all_that_a_document_shows_is_measured_in_one_sitting(name):
    kept = [json.loads((documents.KEPT / f"{subject}.json").read_text()) for subject in documents.TABLES_OF[name]]
    assert {*documents.TABLES_OF[name]} <= {*sitting.SUBJECTS}
    assert all(result["status"] == 0 for subject in kept for result in subject["results"])
    assert len(documents.made(name).splitlines()) > 3


def test_a_new_sitting_changes_the_documents(tmp_path, monkeypatch):
    rows = [
        dict.fromkeys(documents.LOAD) | {"visitors": "2", "first picture s": 1.5, "pictures/s of each": "9.5 to 10.0"}
    ]
    results = [{"command": f"python -m dt_viz.evaluate load{kind} --out F.json", "rows": rows} for kind in KINDS]
    (tmp_path / "load.json").write_text(json.dumps({"results": results}))
    document = tmp_path / "document.md"
    document.write_text("Before\n\n<!-- measured: load -->\n\n| 99 |\n\nAfter\n")
    monkeypatch.setattr(documents, "KEPT", tmp_path / "kept")
    monkeypatch.setattr(documents, "DOCUMENTS", (document,))
    assert main(["documents", str(tmp_path)]) == 0
    text = document.read_text()
    assert text.startswith("Before\n\n<!-- measured: load -->\n\n| visitors | first picture s | pictures/s of each |")
    assert "| 2 | 1.5 | 9.5 to 10.0 |" in text and "| 2, lecture | 1.5 |" in text and "99" not in text
    assert text.endswith("|\n\nAfter\n") and documents.filled(text) == text


KINDS = ("", " --lecture")
