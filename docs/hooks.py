"""Put CHANGELOG.md, which is next to the folder of the documentation, on the site, and formulas as MathML.

Browsers draw MathML themselves: the site needs no script and no network for its formulas.
"""

import html
import re
from pathlib import Path

from latex2mathml.converter import convert
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

# What pymdownx.arithmatex makes of $...$ and $$...$$: \\(...\\) in a span, \\[...\\] in a div.
FORMULA = re.compile(r'<(span|div) class="arithmatex">\\[(\[](.*?)\\[)\]]</\1>', re.DOTALL)
TIGHT = re.compile(r"<mo([^>]*>&#x0(?:002F|007C|2016);)</mo>")  # / | and ||, without space around them
# A function before its argument, which follows it without a space.
FUNCTION = re.compile(
    r"((?<!<msub>)(?<!<msup>)(?<!<munder>)<mi>(?:log|ln|exp|sin|cos|tan|det|max|min)</mi>"
    r"|<msub><mi>log</mi>(?:<mn>\d+</mn>|<mrow><mn>\d+</mn></mrow>)</msub>)"
    r"(?=<m(?:i|n|sub|sup|subsup|frac)>)"
)


def on_files(files: Files, *, config: MkDocsConfig) -> Files:
    content = (Path(config.config_file_path).parent / "CHANGELOG.md").read_text(encoding="utf-8")
    files.append(File.generated(config, "changelog.md", content=content))
    return files


def on_page_content(content: str, **_: object) -> str:
    return FORMULA.sub(draw_formula, content)


def draw_formula(formula: re.Match[str]) -> str:
    """Return the MathML of a formula in LaTeX."""
    tag, latex = formula[1], html.unescape(formula[2]).strip()
    display = "block" if tag == "div" else "inline"
    drawn = TIGHT.sub(r'<mo lspace="0" rspace="0"\1</mo>', convert(latex, display=display))
    drawn = FUNCTION.sub(r'\1<mspace width="0.17em"/>', drawn)
    return f'<{tag} class="formula">{drawn}</{tag}>'
