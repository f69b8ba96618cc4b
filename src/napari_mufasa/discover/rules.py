"""Every number that a diagnosis decides by, in one place.

Given are how often chance may be taken for an effect (the false-alarm budget), how much of a measurement is worth
explaining, how far a step reaches, and how many simulations may be spent. Everything else a diagnosis goes by (spreads,
correlations, floors, the laws of chance) comes from its own simulations. (How an observable is measured, and how a map
or a course is read off a movie, is said where that is done.)
"""

from __future__ import annotations

# The false-alarm budget -------------------------------------------------------------------------------------
ALARM = 0.02  # when nothing is missing, some effect stands out from chance so often (more often than one in all base
# simulations, or a single freak among them would rule what an effect must bring)
MISFIT_ALARM = 0.005  # … and the misfit as a whole
FURTHER = 0.01  # each effect beside another must be worth more than what chance gives the best one so often
STILL_OFF = 0.001  # … and what an explanation leaves is called unexplained beyond this chance
SURE = 1e-3  # evidence that chance gives so rarely is enough where the error is at its floor and cannot fall
CONTENT = 0.05  # a fit that leaves a misfit which chance exceeds more often than this is left as it is

# What is worth explaining -----------------------------------------------------------------------------------
UNSURE = 0.95  # a name that is less sure than this is one of several
AT_FLOOR = 1.15  # a held-out error within this factor of its floor is at the floor
NOT_RISEN = 1.03  # how far an error may rise: at its floor with a lone effect that is sure, and with a likelier form
FALLS = 1.04  # times the error: so much it must be without an effect that stands beside others
FAR_OFF = 2.5  # above so many floors what a model promises of its neighbourhood is not to be had
FAR = 1.35  # an error above so many floors is not explained, however far it fell (and an effect without which it would
# be below, at the floor, is told by a whole fit) …
EXPLAINED = 0.6  # … nor is one of which less than this share went away
NEARLY_ALL = 0.9  # of the simulations of a model: an observable that fewer of them show is not measurable
OFF = 3.0  # an observable farther off than so many standard deviations is failing
PLAIN = 15.0  # −2 log likelihood by which another form must be better than the plain one (noise of judging: about 5)
NEAR = 6.0  # −2 log likelihood within which two effects cannot be told apart
BEGUN = 20.0  # −2 log likelihood that what is begun, and not fitted yet, may fall behind: known rivals are fitted then
UNCOMMON = 12.0  # −2 log likelihood: so much less likely is an effect that few movies have, beside a common one
BESIDE = 0.4  # of the best lead's evidence: what promises less and moves the same waits until that one is in the model
FORM_FIRST = 0.3  # of the misfit left: leads that promise less wait until forms of what is in the model have been
# tried; so do those that move what an effect in the model moves, or are known to look like it
RIVAL = 0.5  # of what an effect is worth, or promises: what would explain so much of it in its place is tried there
KNOWN = 0.05  # … or so much of it, where both are known to look alike
RIVALS = 2  # … but no more of them
ALIKE = 0.5  # of what two effects move: so much the same, and one may stand in the place of the other
FORM_ERROR = 0.15  # of what an effect moves: so far may its law in the measurement be from that of the catalogue
SHAPE = 0.015  # of the evidence of each other effect, so far as that moves the same: so much an effect must be worth,
# for what the others leave is also the error of their form
FAR_LESS = 0.5  # of the evidence that effects need: those that are worth less are taken out together
CLEAR = 2.0  # times the evidence that it needs: what a few simulations say an effect is worth so much, is worth it
DOUBTFUL = 2 / 3  # of the error that is off without an effect: one that takes away less may be the error of another's
# form, and a name that is less sure than this is told as such
FORM_WORTH = 0.2  # of the best form's evidence: another form of an effect is tried; and a rival whose settings end
# before it is at its best; of all that is explained: what is worth less may be its rival's form
NEARER = 0.97  # of the misfit: simulations of where a step downhill leads confirm it
PROMISED = 2.0  # −2 log likelihood: a step downhill of which the slopes promise less is not worth its simulations
LINEAR = 0.4  # log units or quarters of the range: as far about as a model is linear in a parameter
CAMERA_OFF = 0.1  # log units: a gain or read noise so far off is set right before anything else is looked at
DEEPER = 0.9  # of the misfit: a place further downhill is worth derivatives, and the simulations of its neighbourhood

# How far steps reach ------------------------------------------------------------------------------------------
# Coordinates of values and parameters are log units, or quarters of the plausible range.
SOFT = 8.0  # standard deviations up to which residuals count in full; of larger ones their logarithm does
FREAK = 3.0  # interquartile ranges above the upper quartile: a Gumbel law has 0.3 % beyond
OFF_DATA_SHEET = 0.12  # prior width of gain and read noise where they may be farther off than data sheets err
VALUE_REACH = 2.5  # how many widths of its prior a value of the model may move
MATCHING_ROUNDS = 4  # of the model's values to the movie, before anything is asked
SCALES = (0.12, 0.25, 0.45, 0.7, 1.0, 1.4)  # of a simulated setting: strengths at which a lead is looked at
TAKEN_REACH = 1.5  # how far the strength of a lead that is taken up may move, in its own size
SHAPES_TRIED = (1 / 6, 1 / 2, 5 / 6)  # of the plausible range, of each shape parameter where an effect is started …
LADDER = 2.2  # … factor between the strengths tried first …
AROUND_WIDTH = 0.45  # … and how far simulations around such a start reach
START_PRIOR = 2.5  # prior width of its parameters there, in spreads of these simulations
PRIOR_SIMULATIONS = 6.0  # that the base model's spread counts as, beside those around a start
PARAMETER_STEP = 0.2  # of an effect in the model, for its derivative …
PARAMETER_PRIOR = 0.5  # … its prior width …
ASKED_PRIOR = 3.0  # … and the one with which its uncertainty is asked for
AT_AN_END = 0.02  # so near an end of its range a shape has come to it

# The budget of simulations ----------------------------------------------------------------------------------
BUDGET = 5_000  # simulations of a movie of ordinary size …
BUDGET_VALUES = 23_000_000_000  # … and pixels times frames, dark ones too, of all together, whichever is less
AT_ONCE = 4  # effects taken up together
DESCENTS = 4  # steps downhill, each with derivatives of its own
BASE_SIMULATIONS = 60  # of a model: its mean, spread and correlations
CAMERA_ROUNDS = 4  # … anew where the camera is set right
CHECK_SIMULATIONS = 12  # of fresh seeds, which none of these has seen
UNREAD = 3  # with what one half of the field shows directly, each beside its twin with what the whole shows
RAYS = 4  # settings of each effect, and one for each of its shape parameters
RENEWED = 10  # effects whose settings are simulated anew at a further stand: those that promise most by the last ones
SLOPE_SEEDS = 3  # pairs for each derivative
START = 40  # for an effect that is started, about …
AROUND = 9  # … these of them around where it starts
FINALISTS = 5  # leads that are started when a user asks what is missing
TRIALS = 4  # that tell which of two models is nearer
UNSEEN = range(TRIALS, 4 * TRIALS)  # those that confirm where a way downhill has led
SHARES = (1.0, 0.5, 0.25)  # how much of a step downhill is tried
STEP_SIMULATIONS = TRIALS * len(SHARES)  # of a step at most
REMOVALS = 6  # of a model without one of its effects
FOLLOWED = 32  # with all free values moved, that tell how far fits follow
LEAST_FOLLOWED = 0.2  # … of which no less is believed
CURVES = 6  # of the model believed and of the completed one, that are drawn
TELLING = FOLLOWED + 2 * CURVES  # that a report takes
FINITE = 0.03  # relative uncertainty of a parameter that this finite number of simulations leaves
