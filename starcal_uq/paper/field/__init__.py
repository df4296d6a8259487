"""The paper's field experiment from rendered frames."""
