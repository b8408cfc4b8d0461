"""Puts the `>>>` examples of docstrings into code blocks on the page of the API."""

import re
from typing import Any

import griffe


class FencedExamples(griffe.Extension):
    """Paragraphs of a docstring that start with `>>>` are code."""

    def on_object(self, *, obj: griffe.Object, **kwargs: Any) -> None:
        if obj.docstring is not None:
            fenced = r"\n```pycon\n\1\n```\n"
            obj.docstring.value = re.sub(r"(?m)^(>>> (?:.*\n?)(?:^.+\n?)*)", fenced, obj.docstring.value)
