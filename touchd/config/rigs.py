"""The settings of what stands in for a DAQ on USB: NI hardware, and an audio interface."""

from __future__ import annotations

from pydantic import Field, ValidationInfo, field_validator

from touchd.config.kinds import Section
from touchd.frame import MAX_SAMPLES


class NiSettings(Section):
    """NI hardware (`--ni`). Not tried on hardware."""

    inputs: str = Field("cDAQ1Mod1/ai0:3", description="Analog inputs, one for each receiver.", min_length=1)
    output: str = Field("cDAQ1Mod2/ao0", description="Analog output that plays the chirp.", min_length=1)
    trigger: str = Field(
        "", description="Terminal that starts the inputs; empty: the start trigger of the output's chassis."
    )
    amplitude_v: float = Field(5.0, gt=0, le=10, description="Of the chirp, V.")
    output_limit_v: float = Field(
        10.0, gt=0, le=100, description="Highest voltage of the output, V, not below `amplitude_v`."
    )

    @field_validator("output_limit_v")
    @classmethod
    def _admits_the_amplitude(cls, limit_v: float, info: ValidationInfo) -> float:
        amplitude_v = info.data.get("amplitude_v", 0.0)
        if amplitude_v > limit_v:
            raise ValueError(f"is {limit_v:g} V, below ni.amplitude_v, {amplitude_v:g} V")
        return limit_v


class AudioSettings(Section):
    """An audio interface (`--audio`); all its outputs play the chirp."""

    device: str = Field("", description="ALSA name of `arecord -L`, such as hw:CARD=U192k.")
    sample_rate_hz: int = Field(192_000, ge=8000, le=768_000, description="A multiple of `device.rate_hz`.")
    channels: tuple[int, ...] = Field(
        (1, 2, 3, 4), description="The input of each disc, counted from 1, in the model's order."
    )
    loopback: int = Field(
        0, ge=0, le=256, description="Input that a cable joins to an output, for the delay; 0: none.",
    )  # fmt: skip
    level_dbfs: float = Field(-6.0, ge=-80, le=0, description="Level of the chirp, dB of full scale.")
    band_hz: tuple[float, float] = Field((20_000.0, 85_000.0), description="Start and end of the chirp, Hz.")
    chirp_s: float = Field(0.004, ge=1e-4, le=0.1, description="Length of the chirp and of a frame, s.")

    @field_validator("channels")
    @classmethod
    def _are_inputs(cls, channels: tuple[int, ...]) -> tuple[int, ...]:
        if not channels or len(set(channels)) < len(channels) or not all(1 <= at <= 256 for at in channels):
            raise ValueError("must be different inputs, counted from 1")
        return channels

    @field_validator("loopback")
    @classmethod
    def _has_no_disc(cls, loopback: int, info: ValidationInfo) -> int:
        if loopback in info.data.get("channels", ()):
            raise ValueError(f"is input {loopback}, which is a disc's in audio.channels")
        return loopback

    @field_validator("band_hz")
    @classmethod
    def _is_a_band(cls, band_hz: tuple[float, float], info: ValidationInfo) -> tuple[float, float]:
        highest_hz = info.data.get("sample_rate_hz", 192_000) / 2
        if not 1 <= band_hz[0] < band_hz[1] < highest_hz:
            most = f"half of the sample rate, {highest_hz:g}"
            usual = round(min(20_000.0, 0.32 * highest_hz), -2), round(0.88 * highest_hz, -2)
            raise ValueError(
                f"must be two frequencies in rising order, below {most}, such as {usual[0]:g}, {usual[1]:g}"
            )
        return band_hz

    @field_validator("chirp_s")
    @classmethod
    def _holds_its_band(cls, chirp_s: float, info: ValidationInfo) -> float:
        start_hz, rate_hz = info.data.get("band_hz", (20_000.0,))[0], info.data.get("sample_rate_hz", 192_000)
        if chirp_s * start_hz < 1:
            raise ValueError(f"is {chirp_s:g} s, less than a period of {start_hz:g} Hz, where audio.band_hz begins")
        if round(chirp_s * rate_hz) > MAX_SAMPLES:
            raise ValueError(f"is {chirp_s:g} s, more than {MAX_SAMPLES} samples at audio.sample_rate_hz, {rate_hz} Hz")
        return chirp_s
