"""CAN: frames and their codec, end-to-end protection, buses, and the receiver that makes samples of frames."""
