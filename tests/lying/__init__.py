"""A node that lies, written anew: codec, CRC, brake and stop of its own, nothing of the project's."""
