"""What recorded signals show before any model: derivatives, directions, holds, noise, spikes, delays, sizes."""
