"""What LCDNet is compared with: other place descriptors and other registrations of clouds."""
