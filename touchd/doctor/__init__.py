"""What `touchd doctor` examines: frames (`checks`), the computer (`host`) and the USB device (`usb`)."""
