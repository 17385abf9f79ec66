"""Looking at drives: telemetry folders read back, plots, videos and a viewer."""
