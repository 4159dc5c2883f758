"""The vli command: offline pipeline, replay, evaluation and demo; see docs/architecture.md."""
