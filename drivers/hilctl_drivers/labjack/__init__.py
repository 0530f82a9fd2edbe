"""LabJack T-series: streaming from the device's buffer."""
