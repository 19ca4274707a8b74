"""The bottom room: what runs on the device, and the contracts that all rooms share."""
