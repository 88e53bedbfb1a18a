"""What a person does, as functions: train, evaluate, verify, meta-test, transfer, sweep, record."""
