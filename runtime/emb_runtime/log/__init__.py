"""The log: records cross a ring buffer in shared memory to the process that writes the MCAP file."""
