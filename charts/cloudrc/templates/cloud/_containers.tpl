{{/* Containers and volumes of a robot's cloud: in a pod of their own, or in that of world if cloud.place is
     onboard. Argument: the root. */}}
{{- define "cloudrc.cloudContainers" -}}
{{- $image := include "cloudrc.image" (dict "root" . "role" "cloud") -}}
{{- $onboard := include "cloudrc.onboard" . | empty | not -}}
{{- $metrics := $onboard | ternary 9103 9100 -}}
{{- $port := $onboard | ternary "cloud-metrics" "metrics" -}}
# The control loop alone. teleop and `ros` connect through sockets without tokens, so no other
# container mounts their folder.
- name: cloud
  image: {{ $image }}
  imagePullPolicy: {{ .Values.image.pullPolicy }}
  args:
    - process
    - cloud
    - --config=/etc/cloudrc/experiment.yaml
    {{- include "cloudrc.endArgs" (dict "root" . "component" "cloud") | nindent 4 }}
    - --teleop=/run/cloudrc-teleop
    {{- if include "cloudrc.hasReaders" . }}
    - --records=/run/cloudrc-records
    {{- end }}
    - --key=/etc/cloudrc-secret/key
    - --record=/var/lib/cloudrc/cloud.mcap
    - --record-flights
    - --record-max={{ include "cloudrc.recordMax" (dict "root" . "component" "cloud") }}
    - "--metrics=[::]:{{ $metrics }}"
  ports:
    {{- if not $onboard }}
    - {name: tunnel, containerPort: 7400, protocol: UDP}
    {{- end }}
    - {name: {{ $port }}, containerPort: {{ $metrics }}, protocol: TCP}
  {{- include "cloudrc.probes" $port | nindent 2 }}
  terminationMessagePolicy: FallbackToLogsOnError
  {{- include "cloudrc.containerSecurity" $ | nindent 2 }}
  resources:
    {{- toYaml .Values.cloud.resources | nindent 4 }}
  {{- include "cloudrc.env" (list . .Values.cloud) | nindent 2 }}
  volumeMounts:
    {{- include "cloudrc.endMounts" . | replace "name: data" (ternary "name: data-cloud" "name: data" (and $onboard (not (include "cloudrc.recordingsClaim" .)))) | nindent 4 }}
    - {name: teleop, mountPath: /run/cloudrc-teleop}
    {{- if include "cloudrc.hasReaders" . }}
    - {name: records, mountPath: /run/cloudrc-records}
    {{- end }}
    {{- include "cloudrc.extraMounts" .Values.cloud | nindent 4 }}
- name: teleop
  image: {{ $image }}
  imagePullPolicy: {{ .Values.image.pullPolicy }}
  args:
    - process
    - teleop
    - --config=/etc/cloudrc/experiment.yaml
    {{- with include "cloudrc.robotArg" . }}
    {{- . | nindent 4 }}
    {{- end }}
    - --socket=/run/cloudrc-teleop
    - "--api=[::]:8080"
    - --tokens=/etc/cloudrc-tokens
    - --journal=/var/lib/cloudrc-journal/missions.journal
    - --link=/run/cloudrc/link.json
    - "--metrics=[::]:9101"
  ports:
    - {name: api, containerPort: 8080, protocol: TCP}
    - {name: teleop-metrics, containerPort: 9101, protocol: TCP}
  {{- include "cloudrc.probes" "teleop-metrics" | nindent 2 }}
  terminationMessagePolicy: FallbackToLogsOnError
  {{- include "cloudrc.containerSecurity" $ | nindent 2 }}
  resources:
    {{- toYaml .Values.teleop.resources | nindent 4 }}
  {{- include "cloudrc.env" (list . .Values.teleop) | nindent 2 }}
  volumeMounts:
    {{- include "cloudrc.experimentMounts" . | nindent 4 }}
    - {name: run, mountPath: /run/cloudrc, readOnly: true}
    - {name: teleop, mountPath: /run/cloudrc-teleop}
    - {name: tokens, mountPath: /etc/cloudrc-tokens, readOnly: true}
    - {name: journal, mountPath: /var/lib/cloudrc-journal{{ include "cloudrc.isFleet" . | empty | ternary "" ", subPathExpr: robot-$(ROBOT)" }}}
    {{- include "cloudrc.extraMounts" .Values.teleop | nindent 4 }}
{{- if .Values.cloud.ros.enabled }}
{{- $controls := dict "root" . "of" .Values.cloud.ros }}
# cloudrc's own node: it publishes what the controller needs, and hears its answers.
- name: ros
  image: {{ $image }}
  imagePullPolicy: {{ .Values.image.pullPolicy }}
  args:
    - policy
    - drive
    - --config=/etc/cloudrc/experiment.yaml
    {{- with include "cloudrc.robotArg" . }}
    {{- . | nindent 4 }}
    {{- end }}
    - --socket=/run/cloudrc-teleop
  {{- include "cloudrc.rosSettings" $controls | nindent 2 }}
  volumeMounts:
    {{- include "cloudrc.experimentMounts" . | nindent 4 }}
    - {name: teleop, mountPath: /run/cloudrc-teleop}
    {{- include "cloudrc.rosMounts" (merge (dict "name" "ros") $controls) | nindent 4 }}
# The user's nodes, which reach nothing but the topics.
- name: nodes
  image: {{ $image }}
  imagePullPolicy: {{ .Values.image.pullPolicy }}
  command: [with-ros]
  args:
    {{- toYaml .Values.cloud.ros.launch | nindent 4 }}
  {{- include "cloudrc.rosSettings" $controls | nindent 2 }}
  volumeMounts:
    {{- include "cloudrc.rosMounts" (merge (dict "name" "nodes") $controls) | nindent 4 }}
{{- end }}
{{- if .Values.ros.enabled }}
{{- $shows := dict "root" . "of" .Values.ros "name" "bridge" }}
# Publishes cloud's records. It steers through the API, like any operator, or not at all.
- name: bridge
  image: {{ include "cloudrc.image" (dict "root" . "role" "ros") }}
  imagePullPolicy: {{ .Values.image.pullPolicy }}
  args:
    - ros
    - bridge
    - --config=/etc/cloudrc/experiment.yaml
    {{- with include "cloudrc.robotArg" . }}
    {{- . | nindent 4 }}
    {{- end }}
    - --records=/run/cloudrc-records
    - --api=http://127.0.0.1:8080
    {{- if .Values.ros.steer }}
    - --token-file=/etc/cloudrc-tokens/operator
    {{- end }}
    {{- with .Values.ros.namespace }}
    - --namespace={{ . }}
    {{- end }}
  {{- include "cloudrc.rosSettings" $shows | nindent 2 }}
  volumeMounts:
    {{- include "cloudrc.experimentMounts" . | nindent 4 }}
    - {name: records, mountPath: /run/cloudrc-records}
    {{- if .Values.ros.steer }}
    - {name: tokens, mountPath: /etc/cloudrc-tokens, readOnly: true}
    {{- end }}
    {{- include "cloudrc.rosMounts" $shows | nindent 4 }}
{{- end }}
{{- if .Values.console.enabled }}
# Serves a page at the pod's loopback address, which only kubectl port-forward reaches, so its
# probe runs in the container; any answer will do, also that a token is missing. It steers through the API, like any operator. It cannot change the link: 'cloudrc
# console --cluster' reads the changes that it asks for in its log, and carries them out.
- name: console
  image: {{ include "cloudrc.image" (dict "root" . "role" "world") }}
  imagePullPolicy: {{ .Values.image.pullPolicy }}
  args:
    - console
    - --config=/etc/cloudrc/experiment.yaml
    {{- with include "cloudrc.robotArg" . }}
    {{- . | nindent 4 }}
    {{- end }}
    - --api=http://127.0.0.1:8080
    - --token-file=/etc/cloudrc-tokens/operator
    - --profile=/etc/cloudrc-link/profile.yaml
    - --port=8090
    {{- if include "cloudrc.hasCamera" . }}
    - --records=/run/cloudrc-records
    {{- end }}
    {{- with include "cloudrc.consoleOrigins" . }}
    {{- . | trimPrefix "\n" | nindent 4 }}
    {{- end }}
  env:
    - {name: HOME, value: /tmp}
    {{- with include "cloudrc.robotVariable" . }}
    {{- . | nindent 4 }}
    {{- end }}
    {{- with .Values.console.extraEnv }}
    {{- toYaml . | nindent 4 }}
    {{- end }}
  livenessProbe:
    exec:
      # Without `site`, Python starts in a third of the time, which matters on a busy node.
      command:
        - python
        - -IS
        - -c
        - "import socket; s = socket.create_connection(('127.0.0.1', 8090), 25); s.sendall(b'GET / HTTP/1.0' + bytes([13, 10, 13, 10])); s.recv(1)[0]"
    initialDelaySeconds: 60
    periodSeconds: 60
    timeoutSeconds: 30
    failureThreshold: 5
  terminationMessagePolicy: FallbackToLogsOnError
  {{- include "cloudrc.containerSecurity" $ | nindent 2 }}
  resources:
    {{- toYaml .Values.console.resources | nindent 4 }}
  volumeMounts:
    {{- include "cloudrc.experimentMounts" . | nindent 4 }}
    - {name: tokens, mountPath: /etc/cloudrc-tokens, readOnly: true}
    - {name: link, mountPath: /etc/cloudrc-link, readOnly: true}
    - {name: scratch, mountPath: /tmp}
    {{- if include "cloudrc.hasCamera" . }}
    - {name: records, mountPath: /run/cloudrc-records}
    {{- end }}
    {{- include "cloudrc.extraMounts" .Values.console | nindent 4 }}
{{- end }}
{{- with .Values.cloud.backgroundLoad }}
{{- if .enabled }}
# Burns CPU like a neighbour in the same cloud.
- name: load
  image: {{ $image }}
  imagePullPolicy: {{ $.Values.image.pullPolicy }}
  command:
    - sh
    - -c
    - |
      trap 'exit 0' TERM
      for _ in $(seq {{ .workers }}); do
        (while :; do :; done) &
      done
      wait
  {{- include "cloudrc.containerSecurity" $ | nindent 2 }}
  resources:
    {{- toYaml .resources | nindent 4 }}
  {{- include "cloudrc.extraEnv" . | nindent 2 }}
  {{- with include "cloudrc.extraMounts" . }}
  volumeMounts:
    {{- . | nindent 4 }}
  {{- end }}
{{- end }}
{{- end }}
{{- end }}

{{/* Whether another container reads cloud's records: the bridge, or a console with the camera's pictures. */}}
{{- define "cloudrc.hasReaders" -}}
{{- if or .Values.ros.enabled (and .Values.console.enabled (include "cloudrc.hasCamera" .)) }}true{{ end -}}
{{- end }}

{{/* Volumes of these containers alone. */}}
{{- define "cloudrc.cloudVolumes" -}}
{{- with .Values.cloud.extraVolumes -}}
{{ toYaml . }}
{{ end -}}
- name: teleop
  emptyDir:
    medium: Memory
    sizeLimit: 1Mi
{{- if .Values.cloud.ros.enabled }}
- name: tmp-ros
  emptyDir:
    sizeLimit: 64Mi
- name: tmp-nodes
  emptyDir:
    sizeLimit: 64Mi
{{- end }}
{{- if .Values.ros.enabled }}
- name: tmp-bridge
  emptyDir:
    sizeLimit: 64Mi
{{- end }}
{{- if include "cloudrc.hasReaders" . }}
- name: records
  emptyDir:
    medium: Memory
    sizeLimit: 1Mi
{{- end }}
{{- if or .Values.cloud.ros.enabled .Values.ros.enabled }}
- name: shm
  emptyDir:
    medium: Memory
    sizeLimit: 64Mi
{{- end }}
{{- if .Values.console.enabled }}
- name: scratch
  emptyDir:
    sizeLimit: 64Mi
{{- end }}
- name: tokens
  secret:
    secretName: {{ include "cloudrc.tokensName" . }}
    defaultMode: 0440
- name: journal
  {{- if and (include "cloudrc.isFleet" .) (not .Values.teleop.journal.existingClaim) }}
  emptyDir:
    sizeLimit: {{ .Values.teleop.journal.size }}
  {{- else }}
  persistentVolumeClaim:
    claimName: {{ .Values.teleop.journal.existingClaim | default (printf "%s-journal" (include "cloudrc.fullname" .)) }}
  {{- end }}
{{- end }}
