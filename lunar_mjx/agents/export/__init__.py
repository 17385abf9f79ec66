"""A policy outside this package: as ONNX and StableHLO, with a contract and a ROS 2 node that keeps it."""
