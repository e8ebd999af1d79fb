"""What a vademecum answers when its data are known as distributions only."""
