"""What the documentation promises to hold."""

import re
from pathlib import Path

DOCS = Path(__file__).parent.parent / "docs"


def test_every_decision_is_listed() -> None:
    listed = re.findall(r"\]\((\d{4}-[^)]*)\)", (DOCS / "decisions" / "index.md").read_text(encoding="utf-8"))
    assert listed == sorted(path.name for path in (DOCS / "decisions").glob("0*.md"))


def test_nothing_is_loaded_from_elsewhere() -> None:
    settings = (DOCS.parent / "mkdocs.yml").read_text(encoding="utf-8")
    assert "font: false" in settings
    assert "://" not in settings
    for page in DOCS.rglob("*.md"):
        assert not re.search(r"!\[[^]]*\]\(https?:|<script|<img", page.read_text(encoding="utf-8")), page


def test_every_exported_name_has_its_place_in_the_reference() -> None:
    import trifix

    reference = (DOCS / "api.md").read_text(encoding="utf-8")
    assert [name for name in trifix.__all__ if not re.search(rf"^::: trifix\.[\w.]*\b{name}$", reference, re.M)] == []
