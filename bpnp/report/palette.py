"""Colours of runs and estimates, for the page and for figures.

Eight of each scheme that stay apart for readers with normal vision, protanopia and deuteranopia (at least 30 in CIE
Lab) and tritanopia (23), at a contrast of 3 or more against the background. Estimates also differ by their dashes.
"""

LIGHT = ("#002ed0", "#c68500", "#08a76d", "#91290f", "#977dea", "#916393", "#58006e", "#201816")
DARK = ("#12cdff", "#ffb006", "#009b6b", "#986e9f", "#f3d783", "#cd5e1c", "#e7eee7", "#887bff")
# The page itself, light and dark: quiet text, lines between rows, panels, what has the focus, wrong matches.
INKS = {
    "background": ("#ffffff", "#14171c"),
    "text": ("#1b1f24", "#e6e8eb"),
    "quiet": ("#59626d", "#a0a8b3"),
    "line": ("#d5dae0", "#363c45"),
    "panel": ("#f5f6f8", "#1d2128"),
    "focus": ("#0b57d0", "#8ab4f8"),
    "wrong": ("#b3261e", "#ff8a80"),
} | {f"c{i}": inks for i, inks in enumerate(zip(LIGHT, DARK, strict=True))}
QUIET = INKS["quiet"][0]
VERDICTS = {"confident": LIGHT[2], "ambiguous": LIGHT[1], "failed": LIGHT[3]}
DASHES = ((), (6.0, 3.0), (2.0, 2.0), (9.0, 3.0, 2.0, 3.0))
