"""USB ids, vendor and product, of the adapters that are recognised; add a new one here."""

from typing import Final

FTDI_X: Final = (0x0403, 0x6015)  # id of FTDI's chip, in the adapter that XELA ships, but also in grippers and cables

SLCAN_ADAPTERS: Final = {
    FTDI_X: "VScom USB-CAN Plus",
    (0xAD50, 0x60C4): "CANable, slcan firmware",  # the id of CANtact, from which its firmware is derived
    (0x16D0, 0x117E): "CANable 2, slcan firmware",
}
"""Adapters on a serial port, which speak slcan."""

GS_USB_ADAPTERS: Final = {
    (0x1D50, 0x606F): "candleLight",  # and most of its kin, CANable among them
    (0x1209, 0x2323): "candleLight",
    (0x1209, 0xCA01): "CANnectivity",
    (0x1CD2, 0x606F): "CES CANext FD",
    (0x16D0, 0x10B8): "ABE CANdebugger FD",
}
"""Adapters that speak gs_usb. Source: Linux drivers/net/can/usb/gs_usb.c, and CANnectivity."""
