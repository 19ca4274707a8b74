"""The top room: command line, detector, training, evaluation, report, simulation, model zoo."""
