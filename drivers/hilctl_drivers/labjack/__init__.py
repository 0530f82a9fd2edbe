"""LabJack T-series: feedback messages (function 76), and streaming from the device's buffer."""
