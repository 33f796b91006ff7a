"""Frames of a team: registration of maps and submaps, pose graph, repair of drift; arrays only, no files and no clock."""
