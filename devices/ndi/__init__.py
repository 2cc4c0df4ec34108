"""NDI trackers (Polaris, Vega, Aurora) over a serial line or TCP, and an emulator of them."""
