"""What a run leaves on disk: JSON documents and OpenEXR images. Only the command imports it."""
