; What can be done to components, completed: the domain that Zaman et al. 2013 print lets a node be powered up, leaves
; what it has mended `bad` as well as `good`, and lacks start_node and shutdown.
(define (domain repair)
  (:requirements :adl :typing :existential-preconditions :action-costs)
  (:types
    component - object
    hardware device node - component) ; hardware has a switch; a device has none, and nothing here mends it
  (:predicates
    (good ?c - component)
    (bad ?c - component)
    (on ?h - hardware)
    (running ?n - node)
    (drives ?n - node ?h - hardware)) ; n is of no use before h is there
  (:functions (total-cost) - number)
  (:action power_up
    :parameters (?h - hardware)
    :precondition (and (not (on ?h)) (bad ?h))
    :effect (and (on ?h) (good ?h) (not (bad ?h))))
  (:action shutdown
    :parameters (?h - hardware)
    :precondition (and (bad ?h) (on ?h))
    :effect (not (on ?h)))
  (:action start_node
    :parameters (?n - node)
    :precondition (and (bad ?n) (not (running ?n))
      (forall (?h - hardware) (imply (drives ?n ?h) (and (on ?h) (good ?h)))))
    :effect (and (running ?n) (good ?n) (not (bad ?n))))
  (:action stop_node
    :parameters (?n - node)
    :precondition (and (bad ?n) (running ?n))
    :effect (and (bad ?n) (not (running ?n)))))
