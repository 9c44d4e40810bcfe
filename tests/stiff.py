"""Stiff problems, restated from their sources: what implicit steps are tried on."""

from __future__ import annotations

import casadi as ca
import numpy as np

import nocl


def linear(rate: float = 1e4) -> nocl.OCP:
    """A mass behind an actuator that settles in 1 / rate."""
    p, v, a, u = (ca.SX.sym(name) for name in ("p", "v", "a", "u"))
    system = nocl.System("stiff_linear", x=ca.vertcat(p, v, a), u=u, xdot=ca.vertcat(v, a, rate * (u - a)),
                         lbu=[-50], ubu=[50], lbx=[-3, -3, -9], ubx=[3, 3, 9])
    return nocl.OCP(system, horizon=2.0, running=0.1 * u**2 + p**2, terminal=5 * p**2 + v**2, x_goal=[0, 0, 0],
                    u_goal=[0], initial_states=nocl.Gaussian([1.0, 0.0, 0.5], [0.1, 0.1, 0.1]))


def van_der_pol(mu: float = 50.0) -> nocl.OCP:
    """x'' = mu ((1 - x^2) x' - x) + u: Hairer and Wanner II, IV.1, with a force."""
    x, v, u = (ca.SX.sym(name) for name in ("x", "v", "u"))
    system = nocl.System("stiff_van_der_pol", x=ca.vertcat(x, v), u=u,
                         xdot=ca.vertcat(v, mu * ((1 - x**2) * v - x) + u), lbu=[-20], ubu=[20], lbx=[-3, -100],
                         ubx=[3, 100])
    return nocl.OCP(system, horizon=2.0, running=x**2 + 0.01 * u**2, terminal=x**2 + 0.01 * v**2, x_goal=[0, 0],
                    u_goal=[0], initial_states=nocl.Gaussian([2.0, 0.0], [0.1, 0.01]))


def robertson() -> nocl.OCP:
    """Robertson's reactions (1966) in a stirred tank, fed with A at a rate u that is to keep C at 0.3."""
    a, b, c, u = (ca.SX.sym(name) for name in ("A", "B", "C", "u"))
    slow, fast, middle = 0.04 * a, 3e7 * b**2, 1e4 * b * c
    system = nocl.System("robertson", x=ca.vertcat(a, b, c), u=u,
                         xdot=ca.vertcat(-slow + middle + u * (1 - a), slow - middle - fast - u * b, fast - u * c),
                         lbu=[0], ubu=[0.2], lbx=[0, 0, 0], ubx=[1, 1e-4, 1])
    return nocl.OCP(system, horizon=40.0, running=(c - 0.3)**2 + 0.1 * (u - 0.02)**2, terminal=10 * (c - 0.3)**2,
                    x_goal=[0.7, 1e-5, 0.3], u_goal=[0.02],
                    initial_states=nocl.Uniform([0.7, 1e-6, 0.0], [1.0, 3e-5, 0.2]))


def polymerisation() -> nocl.OCP:
    """The industrial polymerisation reactor (Lucia et al., 2013), as do-mpc's documentation has it: kg, K, kJ, h.

    Its horizon there is 20 steps of 50 s; its cost, the product, has a small quadratic one of the controls here.
    """
    names = ("m_W", "m_A", "m_P", "T_R", "T_S", "T_M", "T_EK", "T_AWT", "fed", "T_adiab")
    m_W, m_A, m_P, T_R, T_S, T_M, T_EK, T_AWT, *_ = x = [ca.SX.sym(name) for name in names]
    feed, T_in_M, T_in_EK = u = [ca.SX.sym(name) for name in ("feed", "T_in_M", "T_in_EK")]
    R, T_F, E_a, dH, A_tank, k_0, k_U2, k_U1 = 8.314, 298.15, 8500.0, 950.0, 65.0, 7.0, 32.0, 4.0
    m_jacket, f_jacket, m_coolant, f_coolant, m_loop, f_loop, m_steel = 5e3, 3e5, 1e3, 1e5, 200.0, 2e4, 3.9e4
    c_W, c_S, c_F, c_R, alfa = 4.2, 0.47, 3.0, 5.0, 5 * 20e4 * 3.6
    mass, share = m_W + m_A + m_P, m_P / (m_A + m_P)
    rate = [k_0 * ca.exp(-E_a / (R * T)) * (k_U1 * (1 - share) + k_U2 * share) for T in (T_R, T_EK)]
    wall = (17280.0 * m_W + 3600.0 * m_A + 360.0 * m_P) / mass * A_tank
    inside, outside = rate[0] * (m_A - m_A * m_loop / mass), rate[1] * m_A / mass * m_loop
    dm_A = 0.667 * feed - inside - outside
    dT_R = (feed * c_F * (T_F - T_R) - wall * (T_R - T_S) - f_loop * c_R * (T_R - T_EK) + dH * inside) / (c_R * mass)
    xdot = ca.vertcat(
        0.333 * feed, dm_A, inside + outside, dT_R,
        wall * (T_R - 2 * T_S + T_M) / (c_S * m_steel),
        (f_jacket * c_W * (T_in_M - T_M) + wall * (T_S - T_M)) / (c_W * m_jacket),
        (f_loop * c_R * (T_R - T_EK) - alfa * (T_EK - T_AWT) + outside * dH) / (c_R * m_loop),
        (f_coolant * c_W * (T_in_EK - T_AWT) - alfa * (T_AWT - T_EK)) / (c_W * m_coolant),
        feed, dH / c_R * (dm_A - m_A / mass * feed) / mass + dT_R)
    system = nocl.System("polymerisation", x=ca.vertcat(*x), u=ca.vertcat(*u), xdot=xdot,
                         lbu=[0, 333.15, 333.15], ubu=[3e4, 373.15, 373.15],
                         lbx=[8e3, 200, 10, 350, 340, 330, 300, 300, 0, 360],
                         ubx=[2e4, 5e3, 9e3, 375, 375, 375, 375, 375, 3e4, 390])
    start = np.array([1e4, 853.0, 26.5, 363.15, 363.15, 363.15, 308.15, 308.15, 300.0, 0.0])
    start[9] = start[1] * dH / (start[:3].sum() * c_R) + start[3]
    spread = [50, 20, 5, 0.3, 0.3, 0.3, 3, 3, 0, 0.3]
    effort = ((feed - 1e4) / 3e4)**2 + ((T_in_M - 353) / 40)**2 + ((T_in_EK - 353) / 40)**2
    return nocl.OCP(system, horizon=20 * 50 / 3600, running=((T_R - 363.15) / 2)**2 + 0.1 * effort,
                    terminal=-m_P / 1000, x_goal=[*start[:9], start[9]], u_goal=[1e4, 353.0, 353.0],
                    initial_states=nocl.Gaussian(start, spread))
