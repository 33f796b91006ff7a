"""Simulation of a team of robots that explore a procedural village, written as ordinary logs."""
