"""Proposers: functions that return poses to be refined, scored and judged like any other hypothesis."""
