"""What is done with logs besides evaluating them: repairing, exporting, speaking python-can's files, showing."""
