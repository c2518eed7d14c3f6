"""Make samples and train CMRNet; training itself needs neither sensors' formats nor a map."""
