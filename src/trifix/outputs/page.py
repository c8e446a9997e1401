"""What pages share: templates and the way numbers are written. Knows no page."""

from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined


def environment(package: str = "trifix.outputs") -> Environment:
    """Templates of a package and of this folder, text escaped, and how pages write numbers."""
    folders = [PackageLoader(each, ".") for each in dict.fromkeys((package, "trifix.outputs"))]
    templates = Environment(
        loader=ChoiceLoader(folders),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    templates.filters["words"] = lambda name: name.replace("_", " ")
    templates.filters["thousands"] = _thousands
    templates.filters["square"] = lambda value: value**2
    templates.filters["number"] = lambda value: (
        "–" if value is None else _thousands(value) if value >= 1000 else f"{value:.3g}"
    )
    return templates


def _thousands(count: int | float) -> str:
    return f"{count:,.0f}".replace(",", "\u202f")
