"""The data sets that the authors of BPnPNet released."""
