"""The navigation task: drive to a goal over rough, soft ground."""
