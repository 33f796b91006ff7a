"""Bytes to records and back: log readers, decoders, poses, the result file and exports."""
