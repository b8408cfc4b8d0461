"""SoftPOSIT (David, DeMenthon, Duraiswami, Samet, IJCV 2004)."""
