"""Work shared out to processes of this machine or to Ray."""
