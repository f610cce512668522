{{/* A fleet: StatefulSets whose pods are the robots, and perhaps one cell. One robot without a cell has
     Deployments. */}}

{{/* The experiment's section NAME; {} if it has none. Argument: (list $ NAME). */}}
{{- define "cloudrc.section" -}}
{{ get (index . 0).Values.experiment (index . 1) | default dict | toYaml }}
{{- end }}

{{- define "cloudrc.robots" -}}
{{- $fleet := include "cloudrc.section" (list . "fleet") | fromYaml -}}
{{ .Values.robots | default (kindIs "invalid" $fleet.only | ternary $fleet.robots 1) | default 1 | int }}
{{- end }}

{{/* Whether all tunnels go through a cell: "true" or "". */}}
{{- define "cloudrc.hasCell" -}}
{{- if (include "cloudrc.section" (list . "cell") | fromYaml).rate_kbit }}true{{ end -}}
{{- end }}

{{/* Whether the controllers run in the world pods: "true" or "". */}}
{{- define "cloudrc.onboard" -}}
{{- if eq ((include "cloudrc.section" (list . "cloud") | fromYaml).place | default "") "onboard" }}true{{ end -}}
{{- end }}

{{- define "cloudrc.isFleet" -}}
{{- if or (gt (include "cloudrc.robots" . | int) 1) (include "cloudrc.hasCell" .) (include "cloudrc.onboard" .) }}true{{ end -}}
{{- end }}

{{/* Start of the spec of world's or cloud's StatefulSet. */}}
{{- define "cloudrc.statefulSet" -}}
serviceName: {{ include "cloudrc.fullname" .root }}-{{ .component }}
replicas: {{ include "cloudrc.robots" .root }}
revisionHistoryLimit: {{ .root.Values.revisionHistoryLimit }}
# The robots start together, and change together from Kubernetes 1.35 on; before, one after the other.
podManagementPolicy: Parallel
updateStrategy:
  type: RollingUpdate
  rollingUpdate: {maxUnavailable: 100%}
{{- end }}

{{/* Variable with the robot's number, which is the pod's index; nothing without a fleet. */}}
{{- define "cloudrc.robotVariable" -}}
{{- if include "cloudrc.isFleet" . -}}
- name: ROBOT
  valueFrom:
    fieldRef:
      fieldPath: metadata.labels['apps.kubernetes.io/pod-index']
{{- end }}
{{- end }}

{{/* Argument of a process that works for one robot; nothing without a fleet. */}}
{{- define "cloudrc.robotArg" -}}
{{- if include "cloudrc.isFleet" . -}}
- --robot=$(ROBOT)
{{- end }}
{{- end }}

{{/* Environment of a container of world or cloud. Argument: (list $ VALUES), the values of the container. */}}
{{- define "cloudrc.env" -}}
{{- with include "cloudrc.robotVariable" (index . 0) -}}
env:
  {{- . | nindent 2 }}
  {{- with (index $ 1).extraEnv }}
  {{- toYaml . | nindent 2 }}
  {{- end }}
{{- else -}}
{{- include "cloudrc.extraEnv" (index . 1) -}}
{{- end }}
{{- end }}

{{/* Host of a robot's pod, whose number is NUMBER; without a fleet that of the only one.
     Argument: (dict "root" $ "component" NAME "number" NUMBER). */}}
{{- define "cloudrc.hostOf" -}}
{{- $name := printf "%s-%s" (include "cloudrc.fullname" .root) .component -}}
{{ include "cloudrc.isFleet" .root | empty | ternary $name (printf "%s-%s.%s" $name .number $name) }}
{{- end }}

{{/* Arguments of world and cloud: where they listen, and to whom they send. On board they have two ports of
     one pod, and their routes are in the experiment's ConfigMap. */}}
{{- define "cloudrc.endArgs" -}}
{{- if include "cloudrc.onboard" .root -}}
- --listen=127.0.0.1:{{ eq .component "world" | ternary 7400 7401 }}
- --route=/etc/cloudrc/route-{{ .component }}
{{- else -}}
- "--listen=[::]:7400"
- --route=/run/cloudrc/route
{{- end }}
{{- if include "cloudrc.hasCell" .root }}
- --peer={{ include "cloudrc.fullname" .root }}-cell:{{ eq .component "world" | ternary 7400 8400 }}
{{- end }}
{{- with include "cloudrc.robotArg" .root }}
{{ . }}
{{- end }}
{{- end }}

{{/* Component of the pods in which cloud runs. */}}
{{- define "cloudrc.cloudPods" -}}
{{ include "cloudrc.onboard" . | empty | ternary "cloud" "world" }}
{{- end }}

{{/* Label of Kueue, for objects that it may hold back. */}}
{{- define "cloudrc.queue" -}}
{{- with (.Values.scheduling | default dict).queueName -}}
kueue.x-k8s.io/queue-name: {{ . }}
{{- end }}
{{- end }}
