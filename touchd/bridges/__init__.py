"""Programs beside the daemon that hand its touches to others: a touch screen of the kernel's, and TUIO."""
