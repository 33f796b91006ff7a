"""A synthetic village and a team of robots that explore it, written as ordinary logs."""
