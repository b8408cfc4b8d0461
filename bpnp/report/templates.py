"""Pages in HTML from the templates in `assets`."""

from typing import Any

from jinja2 import Environment, PackageLoader

from bpnp.report.points import utf8
from bpnp.report.terminal import INKS


def render_page(template: str, **values: Any) -> str:
    """Return a self-contained page of a template in `assets` for the body; `base.html` has the head and the style.

    Values may contain anything: all text but Markup is escaped, and bytes that are not UTF-8 are replaced.
    """
    environment = Environment(
        loader=PackageLoader("bpnp.report", "assets"),
        autoescape=True,
        finalize=lambda it: utf8(it) if type(it) is str else it,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(template).render(inks=INKS, **values)
